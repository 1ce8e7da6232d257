# SPDX-License-Identifier: GPL-2.0-or-later
"""Which bands of a map are shown in red, green and blue. Knows nothing of QGIS."""

import re
from typing import Any

EIGHT = ["1", "2", "3", "4", "5", "6", "7", "8"]


def shown_bands(names: Any) -> Any:
    """Numbers from 1 of the bands shown in red, green and blue: those called so, else the first three.

    Eight bands without names are taken as WorldView's, as `sattools normalise` takes them.

    Args:
        names: of all bands as QGIS has them, such as ``Band 5: albedo red``; three at least.
    """
    words = [re.findall(r"[a-z]+[0-9]*|[0-9]+", name.partition(": ")[2].lower()) for name in names]
    found = [next((k for k, own in enumerate(words, 1) if colour in own), 0) for colour in ("red", "green", "blue")]
    if all(found):
        return found
    return [5, 3, 2] if [own[-1] if own else "" for own in words] == EIGHT else [1, 2, 3]
