"""Which pairs to match, features, matchers, verification."""
