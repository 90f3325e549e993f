"""The machine that runs: LLVM, versions, variants, memory, optional packages."""
