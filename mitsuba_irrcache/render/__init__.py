"""From caches to an image: camera rays, ray marching, surfaces, film, layers, filter."""
