"""The exercises, a module for each notebook, named as it is without its number."""
