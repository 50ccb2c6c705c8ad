"""Rigid motion, camera models and alignment."""
