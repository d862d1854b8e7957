"""What manifests and recordings hold, told without a model: checks, and templates of manifests."""
