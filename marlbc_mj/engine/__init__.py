"""The engine: model assembly, the compiled closed loop, and World, a batch of worlds."""
