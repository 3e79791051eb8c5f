"""Array types of all rooms, by NumPy's dtype."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Half = NDArray[np.float16]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
UInt64 = NDArray[np.uint64]
UInt32 = NDArray[np.uint32]
UInt8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
