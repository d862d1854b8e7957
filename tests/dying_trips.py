"""A reader of trips that dies of some of them; a worker process imports this module alone."""
