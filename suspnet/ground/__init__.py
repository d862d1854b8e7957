"""What every room stands on: names of parameters, checks of values, files that appear whole."""
