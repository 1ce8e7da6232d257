"""Areas that are fitted in tiles and joined."""
