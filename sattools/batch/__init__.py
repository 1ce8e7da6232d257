"""Many scenes times many configurations, on one machine or a cluster."""
