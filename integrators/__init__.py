"""The integrator plugin ``irrcache``, a module that is executed anew for every variant."""
