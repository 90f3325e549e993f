"""From caches to an image: ray marching, surfaces, film and denoising."""
