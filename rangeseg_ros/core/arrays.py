"""Types of arrays."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]
Indices = NDArray[np.intp]
Labels = NDArray[np.uint16]
Mask = NDArray[np.bool_]
