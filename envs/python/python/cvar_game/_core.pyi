from os import PathLike
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Sights = npt.NDArray[np.float32]
_Folder = str | PathLike[str]
