"""What a depot sees: the state of every suspension of a history, and the plan for the fleet."""
