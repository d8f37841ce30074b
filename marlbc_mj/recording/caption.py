"""The frame around a picture: mission, method and time above it, every agent's priorities and a legend below it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.scenarios.titles import mission_title
from marlbc_mj.util.method_names import source_of
from marlbc_mj.util.palette import AGENT_COLORS, LINK_COLOR, SAFE_DISTANCE_COLOR, SHIELD_COLOR, command_color, ink_on

FULL = 1280, 720  # picture size to which all lengths refer; they scale with the picture
HEADER, FOOTER = 48, 80  # heights of the bars
SHARP = 3  # bars are drawn this many times larger and then reduced, which smooths their edges
PAPER, INK, MUTED, RULE = "#FFFFFF", "#1B1F26", "#5C6470", "#D9DDE3"
GHOST_COLOR = "#A9B2BE"
TEAM_STATES = {2: "in formation", 1: "in column"}
"""Texts for the team's formation, by G."""
LEAST_SHRINK = 0.5
"""The texts of the upper bar are at least this share of their size."""
MEANINGS = {"OA": "obstacle avoidance", "FM": "formation", "FR": "column", "AA": "agent avoidance"}

NumberPlace = Literal["inside", "on", "above"]
"""Place of the agents' numbers: inside their balls, on badges that cover the balls, or on badges above them."""


@lru_cache(maxsize=64)
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), max(size, 4))


@dataclass(frozen=True)
class Caption:
    """Draws the frames of one video; the bars are cached by their content.

    Args:
        width, height: size of the whole frame, including the bars [pixels].
    """

    log: EpisodeLog
    width: int
    height: int
    speed: float | None = None  # None: a still
    numbers: NumberPlace = "inside"
    _bars: dict[object, Image.Image] = field(default_factory=dict)

    @property
    def scale(self) -> float:
        """Scale of this frame's bars, 1 at 1280 x 720; text shrinks less than the picture, so that it stays legible."""
        return float(min(self.width / FULL[0], 1.5 * self.height / FULL[1]) ** 0.6)

    @property
    def header(self) -> int:
        """Height of the upper bar [pixels]."""
        return round(HEADER * self.scale)

    @property
    def picture_height(self) -> int:
        """Height of the scene between the bars [pixels]."""
        return self.height - self.header - round(FOOTER * self.scale)

    def frame(self, picture: np.ndarray, time: float, step: int, labels: np.ndarray, radii: np.ndarray) -> Image.Image:
        """Compose the whole frame.

        Args:
            picture: (picture_height, width, 3) uint8.
            time, step: mission time [s] and the mission step that contains it.
            labels: (N, 2) column and row of the agents' numbers in the picture.
            radii: (N,) radii of the agents in the picture [pixels].
        """
        frame = Image.new("RGB", (self.width, self.height), PAPER)
        image = Image.fromarray(np.ascontiguousarray(picture))
        commands = tuple(self.log.commands[k] for k in self.log.command[step])
        if self.numbers == "inside":
            _number(image, labels, radii)
        else:
            above = self.numbers == "above"
            rims = [PAPER if above else command_color(command) for command in commands]
            _badge(image, labels, max(2, round((13 if above else 12) * self.scale)), rims, above=above)
        frame.paste(image, (0, self.header))
        frame.paste(self._kept("header"), (0, 0))
        frame.paste(self._kept((commands, int(self.log.formation[step]))), (0, self.header + self.picture_height))
        self._clock(frame, time)
        return frame

    def _clock(self, frame: Image.Image, time: float) -> None:
        place = (self.width - 24 * self.scale, 0.5 * self.header)
        ImageDraw.Draw(frame).text(place, f"t = {time:5.1f} s", INK, _font(round(20 * self.scale), True), "rm")

    def _kept(self, key: object) -> Image.Image:
        if key not in self._bars:
            height = self.header if key == "header" else self.height - self.header - self.picture_height
            pen = Pen(self.width, height, SHARP * self.scale)
            if isinstance(key, tuple):
                _draw_footer(pen, self.log, *key)
            else:
                _draw_header(pen, self.log, self.speed)
            self._bars[key] = pen.image.resize((self.width, height), Image.Resampling.BOX)
        return self._bars[key]


def _badge(image: Image.Image, labels: np.ndarray, radius: int, rims: Sequence[str], *, above: bool) -> None:
    """Draw every agent's number on a disc of its color; with ``above``, the disc is higher, so that it hides no robot."""
    side, rim = 2 * radius * SHARP, SHARP * (2 if above else max(2, round(0.25 * radius)))
    for agent, (column, row) in enumerate(labels):
        if not (0 <= column < image.width and 0 <= row < image.height):
            continue
        color = AGENT_COLORS[agent % len(AGENT_COLORS)]
        badge, mask = Image.new("RGB", (side, side), color), Image.new("L", (side, side))
        ImageDraw.Draw(mask).ellipse((0, 0, side - 1, side - 1), 255)
        pen = ImageDraw.Draw(badge)
        pen.ellipse((SHARP, SHARP, side - 1 - SHARP, side - 1 - SHARP), color, rims[agent], rim)
        size = round((1.15 if above else 1.05) * radius * SHARP)
        pen.text((side // 2, side // 2), str(agent + 1), ink_on(color), _font(size, True), "mm")
        small = badge.resize((2 * radius, 2 * radius), Image.Resampling.BOX), mask.resize((2 * radius,) * 2, Image.Resampling.BOX)
        image.paste(small[0], (round(column) - radius, round(row) - (2 if above else 1) * radius), small[1])


def _number(image: Image.Image, labels: np.ndarray, radii: np.ndarray) -> None:
    """Write every agent's number on its ball."""
    pen = ImageDraw.Draw(image)
    for agent, (column, row) in enumerate(labels):
        if not (0 <= column < image.width and 0 <= row < image.height):  # NaN behind the camera
            continue
        size = round(min(1.25 * radii[agent], 0.05 * image.height))
        if size >= 6:
            ink = ink_on(AGENT_COLORS[agent % len(AGENT_COLORS)])
            pen.text((column, row), str(agent + 1), ink, _font(size, True), "mm")


class Pen:
    """Draws on a bar from left to right; all lengths are in pixels of a picture of 1280 x 720."""

    def __init__(self, width: int, height: int, scale: float) -> None:
        self.scale = scale
        self.image = Image.new("RGB", (width * SHARP, height * SHARP), PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self.x = 24.0
        self.width = width * SHARP / scale

    def font(self, size: float, bold: bool = False) -> ImageFont.FreeTypeFont:
        """The font for text of ``size`` [pixels of the full picture]."""
        return _font(round(size * self.scale), bold)

    def length(self, text: str, size: float, bold: bool = False) -> float:
        """Width of a text [pixels of the full picture]."""
        return float(self.font(size, bold).getlength(text)) / self.scale

    def text(self, text: str, y: float, size: float, color: str, *, bold: bool = False, gap: float = 0.0) -> None:
        """Write a text, vertically centered at ``y``, and advance."""
        self.draw.text((self.x * self.scale, y * self.scale), text, color, self.font(size, bold), "lm")
        self.x += self.length(text, size, bold) + gap

    def pill(self, text: str, y: float, size: float, color: str, *, width: float = 0.0, gap: float = 0.0) -> None:
        """Write a text on a rounded colored background at least ``width`` wide, and advance."""
        width = max(width, self.length(text, size, True) + 1.4 * size)
        half = 0.82 * size
        box = [v * self.scale for v in (self.x, y - half, self.x + width, y + half)]
        self.draw.rounded_rectangle(box, half * self.scale, color)
        middle = ((self.x + 0.5 * width) * self.scale, y * self.scale)
        self.draw.text(middle, text, ink_on(color), self.font(size, True), "mm")
        self.x += width + gap

    def dot(self, y: float, radius: float, color: str, *, gap: float = 0.0) -> None:
        """Draw a filled circle, and advance."""
        box = [v * self.scale for v in (self.x, y - radius, self.x + 2 * radius, y + radius)]
        self.draw.ellipse(box, color)
        self.x += 2 * radius + gap

    def clear(self, x: float) -> None:
        """Cut off what is drawn on the bar to the right of ``x``."""
        self.draw.rectangle([x * self.scale, 0, self.image.width, self.image.height], PAPER)

    def rule(self, y: float) -> None:
        """Draw a hairline across the bar."""
        self.draw.line([0, y * self.scale, self.image.width, y * self.scale], RULE, round(self.scale))

    def dashes(self, y: float, color: str, *, gap: float = 0.0) -> None:
        """Draw a short dashed line, and advance."""
        for k in range(3):
            start = self.x + 10 * k
            self.draw.line([v * self.scale for v in (start, y, start + 6, y)], color, round(2 * self.scale))
        self.x += 26 + gap

    def stroke(self, y: float, color: str, *, gap: float = 0.0) -> None:
        """Draw a short line, and advance."""
        self.draw.line([v * self.scale for v in (self.x, y, self.x + 26, y)], color, round(2 * self.scale))
        self.x += 26 + gap


def _draw_header(pen: Pen, log: EpisodeLog, speed: float | None) -> None:
    """Mission, methods and seed, smaller and at last cut off if they would reach the playback speed or the clock."""
    y, gap = 0.5 * HEADER, 18.0
    end = pen.width - 24 - pen.length("t = 000.0 s", 20, True) - (0 if speed is None else 84)
    methods = " + ".join(source_of(name).display for name in (log.supervisor, log.controller) if name)
    texts = [(mission_title(log.scenario), 20, INK, True), (methods, 17, INK, False)]
    if log.seed:
        texts.append((f"seed {log.seed}", 15, MUTED, False))
    shrink, room = 1.0, end - pen.x
    while shrink > LEAST_SHRINK and sum(pen.length(text, shrink * size, bold) + gap for text, size, _, bold in texts) > room:
        shrink -= 0.02
    for text, size, color, bold in texts:
        pen.text(text, y, shrink * size, color, bold=bold, gap=gap)
    pen.clear(end - gap)
    if speed is not None:
        pen.x = end
        pen.pill(f"{speed:g}\N{MULTIPLICATION SIGN}", y, 14, MUTED, width=52)
    pen.rule(HEADER - 1)


def _draw_footer(pen: Pen, log: EpisodeLog, commands: Sequence[str], formation: int) -> None:
    pen.rule(0.5)
    state = TEAM_STATES.get(formation, "")
    room = pen.width - 48 - pen.length(max(TEAM_STATES.values(), key=len), 15, True)
    widest = max(pen.length(_spelled(name), 14, True) for name in log.commands) + 22
    gap = 26 if len(commands) <= 6 else 8
    for agent, command in enumerate(commands):
        rest = len(commands) - agent
        if pen.x + widest + (40 if rest == 1 else 90) > room:
            pen.text(f"+{rest}", 28, 15, MUTED, bold=True)
            break
        pen.pill(str(agent + 1), 28, 15, AGENT_COLORS[agent % len(AGENT_COLORS)], width=25, gap=6)
        pen.pill(_spelled(command), 28, 14, command_color(command), width=widest, gap=gap)
    pen.x = pen.width - 24 - pen.length(state, 15, True)
    pen.text(state, 28, 15, INK, bold=True)
    behaviors = list(dict.fromkeys(b for name in log.commands for b in name.split(">")))
    _draw_legend(pen, behaviors, shielded=log.shield.shape[1] > 0, links=log.link.shape[1] > 0)


def _draw_legend(pen: Pen, behaviors: Sequence[str], *, shielded: bool, links: bool) -> None:
    pen.x = 24.0
    for behavior in behaviors:
        pen.dot(60, 6, command_color(behavior), gap=8)
        pen.text(behavior, 60, 13, INK, bold=True, gap=6)
        pen.text(MEANINGS.get(behavior, ""), 60, 13, MUTED, gap=24)
    pen.dashes(60, SAFE_DISTANCE_COLOR, gap=8)
    pen.text("safe distance", 60, 13, MUTED, gap=24)
    pen.dot(60, 4, GHOST_COLOR, gap=8)
    pen.text("reference", 60, 13, MUTED, gap=24)
    if shielded:
        pen.dot(60, 6, SHIELD_COLOR, gap=8)
        pen.text("shield acts", 60, 13, MUTED, gap=24)
    if links:
        pen.stroke(60, LINK_COLOR, gap=8)
        pen.text("link, faded if stale", 60, 13, MUTED)


def _spelled(command: str) -> str:
    return command.replace(">", " > ")
