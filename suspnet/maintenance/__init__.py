"""What a history means for a depot: limits, alarms, remaining life and a plan."""
