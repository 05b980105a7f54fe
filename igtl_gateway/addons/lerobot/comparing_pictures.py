"""Compares the frames of the videos of a data set with the pictures of its recording.

A frame may differ from its picture by the loss of the codec, and by nothing else.  The loss depends on the picture, so
where a frame differs clearly, all pictures are coded again, and block by block the loss is compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.lerobot.checking_videos import Parts, by_file, pictures_of
from igtl_gateway.addons.lerobot.depth import depth_of
from igtl_gateway.addons.lerobot.frames import Plan
from igtl_gateway.addons.lerobot.pictures import Pictures
from igtl_gateway.addons.lerobot.reading import FoundDataSet
from igtl_gateway.addons.lerobot.samples import Samples
from igtl_gateway.addons.lerobot.stats import PictureStats, Stats, sampled
from igtl_gateway.addons.lerobot.video import Pixels, coded

Array = npt.NDArray[Any]

#: A frame shows another picture if the mean squared difference to that one is below this part of its own.
_CLEARLY_LESS = 0.5
#: Mean squared difference that an encoder may cause.
_CODING = 4.0
_NEIGHBOURS = 3
#: Findings of one video that are listed.
_MOST = 5
#: Rows and columns of the blocks that are compared, and the mean squared difference of a block that needs no proof.
_BLOCK, _USUAL = 16, 25.0
#: A block may differ from what the codec gives here by this part of the loss in it and around it: other versions of
#: the codec decide otherwise.
_PART = 0.5


class PictureCheck:
    """The pictures of a feature.

    Args:
        found: the data set, whose episodes have the lengths of the plan.
        plan: the frames that it should have.
        name: the feature.

    Attributes:
        total: the pictures of all episodes that :meth:`stats` was called for.
    """

    def __init__(self, found: FoundDataSet, plan: Plan, name: str) -> None:
        self._found, self._plan, self._name = found, plan, name
        self._samples: Samples = plan.of(name)[0]
        self._row = plan.recipe.rows(name)[0]
        self.total = PictureStats()

    def stats(self, episode: int) -> Stats:
        """Return the statistics of the pictures of an episode of the session, of which the exporter takes samples."""
        pictures = self._samples.pictures
        found = pictures.no_stats() if pictures else PictureStats()
        for frame in sampled(self._plan.episodes[episode].count).tolist():
            found.add(self._picture(episode, frame))
        self.total.join(found)
        return found.stats()

    def frames(self) -> Iterator[str]:
        """Yield the frames that are not the picture of their time, with the loss of coding."""
        pictures = self._samples.pictures
        if pictures is None or pictures.padded != tuple(self._found.info["features"][self._name]["shape"][:2]):
            return  # the rules and the features have it
        for path, parts in by_file(self._found, self._name).items():
            try:
                yield from (self._depths if self._samples.row.depth_mm else self._file)(path, parts, pictures)
            except GatewayError as error:
                yield f"{self._name}: {error}"

    def _own(self, episode: int, frame: int) -> int:
        """The sample of a frame."""
        picks = self._plan.episodes[episode].picks[self._row]
        return int(picks.before[frame]) if picks is not None else 0

    def _picture(self, episode: int, frame: int) -> Pixels:
        return self._of(self._own(episode, frame))

    def _of(self, sample: int) -> Pixels:
        pictures = self._samples.pictures
        assert pictures is not None
        return pictures.rgb(int(self._samples.values[sample]))

    def _file(self, path: Path, parts: Parts, pictures: Pictures) -> Iterator[str]:
        """Another picture of the stream first: the distance in time helps to find the cause."""
        is_usual, others = True, dict[int, str]()
        near: dict[int, Pixels] = {}
        for number, (episode, frame, picture) in enumerate(pictures_of(self._found, self._name, path, parts)):
            own = self._own(episode.index - self._plan.place.episode, frame)
            around = range(max(own - _NEIGHBOURS, 0), min(own + _NEIGHBOURS + 1, len(self._samples.times)))
            near = {each: near[each] if each in near else self._of(each) for each in around}
            is_usual &= bool((_blocks(picture, near[own]) <= _USUAL).all())
            errors = {each: _error(picture, near[each]) for each in around}
            best = min(errors, key=lambda each: errors[each])
            if best != own and errors[own] > _CODING and errors[best] < _CLEARLY_LESS * errors[own]:
                away_ms = (self._samples.times[best] - self._samples.times[own]) / 1e6
                others[number] = (
                    f"episode {episode.index}: {self._name}: frame {frame}: found the picture of entry "
                    f"{self._samples.entries[best]} ({away_ms:+.1f} ms), expected that of entry "
                    f"{self._samples.entries[own]}"
                )
        if others or not is_usual:
            yield from self._losses(path, parts, pictures, others)

    def _depths(self, path: Path, parts: Parts, _pictures: Pictures) -> Iterator[str]:
        """Frames of depth that differ from the recording by anything: their video is lossless."""
        listed, window = 0, self._samples.row.depth_mm
        for episode, frame, picture in pictures_of(self._found, self._name, path, parts):
            own = self._own(episode.index - self._plan.place.episode, frame)
            expected = self._of(own)
            differ = picture != expected
            if differ.any() and listed < _MOST:
                listed += 1
                row, column = (int(each[0]) for each in np.nonzero(differ)[:2])
                one, two = (depth_of(each[row, column, 0], window) for each in (picture, expected))
                yield (
                    f"episode {episode.index}: {self._name}: frame {frame}: found {one:.6g} mm at pixel ({column}, "
                    f"{row}), expected {two:.6g} mm of entry {self._samples.entries[own]} "
                    f"({count_text(int(differ.sum()), 'pixel')})"
                )

    def _losses(self, path: Path, parts: Parts, pictures: Pictures, others: dict[int, str]) -> Iterator[str]:
        """Frames that differ by more than coding does; ``others``: those that look like another picture.

        Of slow and even changes the codec keeps nothing for some frames: the coded picture then looks like one before.
        """
        recipe, listed = self._plan.recipe, 0
        first = self._plan.place.episode
        wanted = (self._picture(each.index - first, frame) for each, _ in parts for frame in range(each.length))
        again = coded(wanted, pictures.padded, recipe.fps, recipe.codec)
        both = zip(pictures_of(self._found, self._name, path, parts), again, strict=False)
        for number, ((episode, frame, picture), expected) in enumerate(both):
            if np.array_equal(picture, expected):
                continue
            if number in others:
                if _error(picture, expected) > _CODING and listed < _MOST:
                    listed += 1
                    yield others[number]
                continue
            loss = _around(_blocks(expected, self._picture(episode.index - first, frame)))
            found, most = _blocks(picture, expected), _PART * loss + _USUAL
            wrong = found > most
            if wrong.any():
                listed += 1
                if listed > _MOST:
                    return
                row, column = np.unravel_index(int(np.argmax(np.where(wrong, found, 0))), found.shape)
                yield (
                    f"episode {episode.index}: {self._name}: frame {frame}: found a mean squared difference of "
                    f"{found[row, column]:,.0f} around pixel ({column * _BLOCK + _BLOCK // 2}, "
                    f"{row * _BLOCK + _BLOCK // 2}), expected at most {most[row, column]:,.0f} to "
                    f"the coded picture of entry {self._samples.entries[self._own(episode.index - first, frame)]}"
                )


def _error(one: Pixels, two: Pixels) -> float:
    """The mean squared difference, of every fourth pixel."""
    return float(np.mean((one[::2, ::2].astype(np.float32) - two[::2, ::2]) ** 2))


def _blocks(one: Pixels, two: Pixels) -> Array:
    """The mean squared difference of each block."""
    rows, columns = one.shape[:2]
    squared = ((one.astype(np.float32) - two) ** 2).mean(axis=2)
    high, wide = np.arange(0, rows, _BLOCK), np.arange(0, columns, _BLOCK)
    sums = np.add.reduceat(np.add.reduceat(squared, high, axis=0), wide, axis=1)
    return np.asarray(sums / np.outer(np.diff([*high, rows]), np.diff([*wide, columns])))


def _around(blocks: Array) -> Array:
    """The largest value of each block and its neighbours."""
    padded = np.pad(blocks, 1, "edge")
    rows, columns = blocks.shape
    around: Array = np.max([padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)
    return around
