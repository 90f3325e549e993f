"""Gradients of images by the continuous adjoint of radiative transfer."""
