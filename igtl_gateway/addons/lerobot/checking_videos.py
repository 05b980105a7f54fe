"""Checks the videos of a data set: number of frames, times, size, and the statistics of their pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.lerobot.checking_stats import StatsCheck
from igtl_gateway.addons.lerobot.depth import PIXEL_FORMAT, has_codes, no_stats
from igtl_gateway.addons.lerobot.episodes import TOLERANCE_S
from igtl_gateway.addons.lerobot.features import picture_size
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode, VideoPart
from igtl_gateway.addons.lerobot.stats import PictureStats, sampled
from igtl_gateway.addons.lerobot.video import RGB, read_video

Array = npt.NDArray[Any]
Parts = list[tuple[FoundEpisode, VideoPart]]


def check_videos(found: FoundDataSet, stats: StatsCheck) -> Iterator[str]:
    """Yield what is wrong in the videos, which are decoded."""
    for name in found.videos:
        for path, parts in by_file(found, name).items():
            yield from _check_file(found, name, path, parts, stats)


def size_of(found: FoundDataSet, name: str) -> tuple[int, int]:
    """Return rows and columns of a video, as info.json states them."""
    return picture_size(found.info["features"][name])


def form_of(found: FoundDataSet, name: str) -> str:
    """Return the form in which the frames of a video are read."""
    return PIXEL_FORMAT if has_codes(found.info["features"][name]) else RGB


def by_file(found: FoundDataSet, name: str) -> dict[Path, Parts]:
    """Return the files of a feature, each with its episodes in order."""
    files: dict[Path, Parts] = {}
    for episode in found.episodes:
        part = episode.videos[name]
        files.setdefault(part.path, []).append((episode, part))
    return files


def _check_file(found: FoundDataSet, name: str, path: Path, parts: Parts, stats: StatsCheck) -> Iterator[str]:
    total, times = sum(episode.length for episode, _ in parts), list[float]()
    seen: dict[int, PictureStats] = {}
    owners, chosen = _owners(parts), set[int]()
    try:
        for at, picture in read_video(path, size_of(found, name), form_of(found, name)):
            times.append(at)
            if len(times) > total:
                break
            episode, frame = next(owners)
            if frame == 0:
                chosen = set(sampled(episode.length).tolist())
            if frame in chosen:
                own = seen.get(episode.index) or no_stats(found.info["features"][name])
                if own is not None:
                    own.add(picture)
                    seen[episode.index] = own
    except GatewayError as error:
        yield str(error)
        return
    place = str(path.relative_to(found.root))
    yield from (f"{place}: {each}" for each in _times(np.array(times), parts, found.info["fps"]))
    for episode, _ in parts:
        yield from stats.pictures(episode, name, seen.get(episode.index, PictureStats()))


def _owners(parts: Parts) -> Iterator[tuple[FoundEpisode, int]]:
    """Episode and frame number of each frame of a file."""
    return ((episode, frame) for episode, _ in parts for frame in range(episode.length))


def _times(times: Array, parts: Parts, fps: int) -> Iterator[str]:
    total = sum(episode.length for episode, _ in parts)
    if len(times) != total:
        found = count_text(len(times), "frame") if len(times) <= total else f"more than {count_text(total, 'frame')}"
        yield f"found {found}, expected {total:,}"
    away = np.abs(times - np.arange(len(times)) / fps)
    if len(away) and away.max() > TOLERANCE_S:
        worst = int(np.argmax(away > TOLERANCE_S))
        yield f"frame {worst}: found the time {times[worst]:.6f} s, expected {worst / fps:.6f} s"
    first = 0
    for episode, part in parts:
        for text, at, frame in (("from", part.first_s, first), ("to", part.last_s, first + episode.length)):
            if at is not None and abs(at - frame / fps) > TOLERANCE_S:
                yield f"episode {episode.index}: {text}_timestamp: found {at:.6f} s, expected {frame / fps:.6f} s"
        first += episode.length


def pictures_of(
    found: FoundDataSet, name: str, path: Path, parts: Parts
) -> Iterator[tuple[FoundEpisode, int, npt.NDArray[np.uint8]]]:
    """Yield episode, frame number and picture of a file, as ``read_video`` has it.  Raises GatewayError."""
    pictures = read_video(path, size_of(found, name), form_of(found, name))
    for (episode, frame), (_, picture) in zip(_owners(parts), pictures, strict=False):
        yield episode, frame, picture
