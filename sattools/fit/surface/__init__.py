"""The surface field: one height and one colour per cell, trained view by view."""
