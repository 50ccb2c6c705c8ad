"""Building of the workshop bundle: all that a room without network needs, in one folder."""
