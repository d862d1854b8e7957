"""From a recording to an estimate, of both sides as equal or of each part."""
