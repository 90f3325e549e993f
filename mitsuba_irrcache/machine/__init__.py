"""The machine and its software: LLVM, package versions, Mitsuba variants, memory."""
