"""A depot: trains monitored while they run, and the fleet in a browser."""
