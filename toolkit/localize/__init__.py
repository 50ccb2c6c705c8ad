"""The pose of a query picture against a splat map: render what it should see, match, solve, and do it again."""
