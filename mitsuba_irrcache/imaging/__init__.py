"""The plugin's properties, camera rays for the present state of a scene, the composed image."""
