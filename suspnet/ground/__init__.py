"""Common basis of all packages: parameter names, checks of values, records and atomic files."""
