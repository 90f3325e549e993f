"""From caches to an image: ray marching, film, filter."""
