"""Images of a scene: its caches brought up to date, camera rays, the film's layers."""
