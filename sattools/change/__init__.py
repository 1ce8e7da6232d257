"""What has changed between two dates: heights, reflectance, volumes, and how sure that is."""
