"""What installs and starts the workshop on a laptop: Python's standard library only, and imports by relative names.

Its folder is copied into the bundle, where it is a package of its own.
"""
