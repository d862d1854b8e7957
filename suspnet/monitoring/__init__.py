"""From recordings of trips to stiffness and damping along the mileage."""
