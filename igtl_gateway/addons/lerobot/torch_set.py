"""The samples of a data set as PyTorch's tensors.  Only this module imports torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch

from igtl_gateway.addons.lerobot.depth import LEVELS


class Recorded(Protocol):
    """What it needs of a ``RecordedSet``."""

    features: dict[str, Any]
    camera_keys: list[str]
    depth_keys: list[str]

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> dict[str, Any]: ...


class TorchSet(torch.utils.data.Dataset):  # type: ignore[misc,name-defined,type-arg,unused-ignore]
    """A data set for ``torch.utils.data.DataLoader``, with any number of workers; ``RecordedSet.to_torch`` makes it.

    Numbers are tensors with the types of the torch-free samples, pictures (3, rows, columns) float32 from 0 to 1, or
    uint8, depth (1, rows, columns) float32 in whole mm, as LeRobot has it; strings stay.

    Attributes:
        recorded: the torch-free data set, with ``fps``, ``features``, ``stats``, ``episodes``, ``tasks``, ``splits``.
    """

    def __init__(self, recorded: Recorded, image_transforms: Callable[[Any], Any] | None, return_uint8: bool) -> None:
        self.recorded = recorded
        self._transforms, self._is_uint8 = image_transforms, return_uint8

    def __len__(self) -> int:
        return len(self.recorded)

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        return {name: self._tensor(name, value) for name, value in self.recorded[index].items()}

    def _tensor(self, name: str, value: Any) -> Any:
        if isinstance(value, str | list):
            return value
        found = torch.from_numpy(np.asarray(value))
        if name not in self.recorded.camera_keys:
            return found
        found = found.movedim(-1, -3)
        if name in self.recorded.depth_keys:
            return self._depth(found, self.recorded.features[name]["info"])
        if self._is_uint8:
            found = found.contiguous()
        else:
            found = found.to(torch.float32, memory_format=torch.contiguous_format).div_(255)
        return self._transforms(found) if self._transforms else found

    @staticmethod
    def _depth(depth_mm: Any, info: dict[str, Any]) -> Any:
        """The depth that LeRobot makes of the codes of its video, in steps of float32."""
        low, high = info["video.depth_min"], info["video.depth_max"]
        scale = (high - low) / (LEVELS - 1)
        codes = ((depth_mm.contiguous() / 1000 - low) / scale).round_()
        return codes.mul_(scale).add_(low).clamp_(low, high).mul_(1000).round_().clamp_(0, 65535)
