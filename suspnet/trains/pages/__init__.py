"""What people read: reports, overviews, the pages of check and commissioning."""
