"""Fitted scene to georeferenced products."""
