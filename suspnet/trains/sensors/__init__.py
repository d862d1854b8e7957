"""Whether sensors work and are where their manifests say."""
