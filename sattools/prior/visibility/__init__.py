"""What hides what: occlusion, courtyards, consistency of views, edges."""
