"""Dr.Jit helpers, sequences, properties of plugins, cancellation."""
