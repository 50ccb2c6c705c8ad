"""Finding camera poses."""
