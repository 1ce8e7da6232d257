"""Multi-view matching: pairs, cost volume, aggregation, refinement."""
