"""Images with RPC cameras become a scene: corrected cameras, angles, height range, grid."""
