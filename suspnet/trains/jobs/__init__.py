"""What programs do with trains: check, commission, read a fleet, plan."""
