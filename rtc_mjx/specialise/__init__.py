"""Any step of one small world -> the same function, folded to scalar arithmetic and compiled as a few kernels.

MJX is written for any model; once the model is known most of its operations multiply zeros and gather with constant
indices. `specialise` traces a function once, folds it (`graph`, `interpret`), differentiates it by itself (`derivative`) and
emits it (`emit`). The result is an ordinary JAX function: jit, vmap, scan and reverse-mode grad work on it.
"""

from rtc_mjx.specialise.emit import Mode, default_mode
from rtc_mjx.specialise.program import Program, Specialised, compress, specialise
from rtc_mjx.specialise.stored import kept

__all__ = ["Mode", "Program", "Specialised", "compress", "default_mode", "kept", "specialise"]
