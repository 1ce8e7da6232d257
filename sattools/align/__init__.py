"""A scene is brought onto a reference: its surface, its maps and its cameras together."""
