"""Physics as pure CasADi functions: rotations, frames, motion, measurements."""
