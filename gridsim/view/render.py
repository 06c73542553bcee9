"""Pictures: a state of the simulator as an RGB array, or in a window. The state is not changed.

Each pixel of the ground is coloured by the road's clearance there, so that edges are smooth at any scale and rotation,
and a torus has no seam. Everything else but text is rounded boxes (for example, lane marks, cars and rays),
blended by the share of a pixel that they cover. None of this needs a display; pygame opens the window.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gridsim.config import SimConfig, constants
from gridsim.errors import GridSimError
from gridsim.jit import freeze
from gridsim.maps.lights import programs_of_lines
from gridsim.maps.map import Map
from gridsim.packages import check_extra
from gridsim.state import CLOCK, COS, SIN, STEERING, X, Y
from gridsim.view import paint
from gridsim.view.display import has_display
from gridsim.view.marks import lane_marks

METRES = 52.0  # height of a picture, in units (`SimConfig.unit`), which are metres except for small cars
CAR_AT = 0.74  # where the car is in a picture, as a share of the picture's height from the top


class NoDisplayError(GridSimError):
    """No window can be opened; the message is one line that says what to do."""


class Renderer:
    """Draws pictures of one map around a car, whose heading is upwards. A torus repeats without a seam."""

    def __init__(self, road_map: Map, size: tuple[int, int] = (640, 480), config: SimConfig | None = None):
        """Prepare pictures of `size` (width, height in pixels)."""
        width, height = size
        self.road_map, self.size = road_map.magnified(), size
        self.config = config or SimConfig()
        self._constants = constants(self.config)
        self._per_m = float(road_map.road.per_m)
        self._road = paint.smoothed(self.road_map.road)
        self.pixels_per_m = height / METRES
        self._anchor = np.array([width / 2, height * CAR_AT])
        self._centre, self._up = self.road_map.size / 2, np.array([0.0, 1.0])
        self._marks = lane_marks(self.road_map)
        self._programs = programs_of_lines(self.road_map.network)
        self._parked = self.road_map.strips.blocks
        vehicle, k = self.config.vehicle, self._constants
        lengths = vehicle.length, vehicle.width, float(k.front_axle), float(k.rear_axle)
        a, b, front, rear = (length * self._per_m for length in lengths)
        self._outline = a, b, front, rear
        self._other = paint.car_parts(*self._outline, 0.0, paint.OTHER)

    def pixel(self, points: np.ndarray) -> np.ndarray:
        """Pixels float64 [n, 2] (x right, y down) of points [n, 2] (units) in the last picture drawn.

        On a torus, a point repeats; the pixel is that of its copy nearest to the car.
        """
        offset = self.road_map.shortest(np.asarray(points, dtype=np.float64).reshape(-1, 2) - self._centre)
        return self._anchor + self._turn(offset) * self.pixels_per_m

    def _turn(self, vectors: np.ndarray) -> np.ndarray:
        """Directions [n, 2] on the map as directions in the picture (y down)."""
        (ux, uy), (x, y) = self._up, vectors.T
        return np.stack([x * uy - y * ux, -(x * ux + y * uy)], axis=1)

    def _near(self, pixels: np.ndarray, margin: float) -> np.ndarray:
        """Which of pixels [n, 2] are in the picture, or within `margin` pixels of it."""
        return np.all((pixels > -margin) & (pixels < np.array(self.size) + margin), axis=1)

    def draw(
        self,
        car: np.ndarray,
        boxes: np.ndarray | None = None,
        ranges: np.ndarray | None = None,
        path: np.ndarray | None = None,
        text: Sequence[str] = (),
        route: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draw a state: uint8 [h, w, 3].

        Args:
            car: the car's state float32 [CAR_FIELDS] (`gridsim.state`).
            boxes: other cars [n, 4 or more]: x, y (m), heading (cosine, sine).
            ranges: ranges of the car's rays [rays], m.
            path: the car's past positions [n, 2], m.
            text: a line for the lower left, and one for the upper left.
            route: points of the car's route [n, 2], m.
        """
        width, height = self.size
        position, heading = np.asarray(car[[X, Y]], np.float64) * self._per_m, np.asarray(car[[COS, SIN]], np.float64)
        self._centre, self._up = position, heading / max(math.hypot(*heading), 1e-9)
        image = np.empty((height, width, 3), dtype=np.uint8)
        right = np.array([self._up[1], -self._up[0]])
        metre = 1.0 / self.pixels_per_m
        origin = self._centre - (self._anchor[0] - 0.5) * metre * right + (self._anchor[1] - 0.5) * metre * self._up
        steps = right * metre, -self._up * metre
        paint.draw_ground(self._road, self.road_map.torus, origin, *steps, self.pixels_per_m, image)
        seconds = int(car[CLOCK] * self.config.episode.control_period)
        shapes = [self._mark_shapes(), self._block_shapes(), self._light_shapes(seconds)]
        if path is not None:
            shapes.append(self._path_shapes(np.asarray(path, dtype=np.float64) * self._per_m))
        if route is not None:
            at = self.pixel(route * self._per_m)
            flat = np.broadcast_to([1.0, 0.0], at.shape)
            shapes.append(self._shapes(at, flat, 0.45, 0.45, 0.45, paint.ROUTE, 1.0, 2.0))
        if ranges is not None:
            shapes.append(self._ray_shapes(position, heading, np.asarray(ranges, dtype=np.float64) * self._per_m))
        if boxes is not None:
            shapes.append(self._placed(self._other, boxes[:, :2] * self._per_m, boxes[:, 2:4]))
        own = paint.car_parts(*self._outline, float(car[STEERING]), paint.EGO)
        shapes.append(self._placed(own, position[None], heading[None]))
        paint.draw_shapes(freeze(np.concatenate(shapes)), image)
        for line, corner in zip(text, ("lower", "upper"), strict=False):
            if line:
                self._write(image, line, corner)
        return image

    def _shapes(
        self,
        centre: np.ndarray,
        direction: np.ndarray,
        length: np.ndarray | float,
        across: float,
        radius: float,
        colour: Sequence[float] | np.ndarray,
        opacity: float,
        least: float = 0.5,
    ) -> np.ndarray:
        """Shapes [n, 11] at pixels `centre` [n, 2], with directions [n, 2] in the picture.

        `length` and `across`, half the length and half the width, and `radius`, of the corners, are in units. If
        `across` is below `least` pixels, the shape is drawn `least` pixels wide to each side, and fainter.
        """
        scale = self.pixels_per_m
        shapes = np.empty((len(centre), paint.SHAPE), dtype=np.float32)
        shapes[:, 0:2], shapes[:, 2:4] = centre - 0.5, direction  # pixel (0, 0) has its centre at (0.5, 0.5)
        drawn = max(across * scale, least)
        shapes[:, 4] = np.maximum(length * scale, drawn)
        shapes[:, 5], shapes[:, 6] = drawn, min(radius * scale, drawn)
        shapes[:, 7:10] = colour
        shapes[:, 10] = opacity * min(1.0, across * scale / least)
        return shapes

    def _mark_shapes(self) -> np.ndarray:
        marks = self._marks
        at = self.pixel(marks[:, :2])
        seen = self._near(at, 2.0 * self.pixels_per_m)
        marks, at = marks[seen], at[seen]
        colour = np.where(marks[:, 5:6] > 0, np.array(paint.MARK_OPPOSITE), np.array(paint.MARK))
        return self._shapes(at, self._turn(marks[:, 2:4]), marks[:, 4], 0.07, 0.02, colour, 0.9)

    def _light_shapes(self, seconds: int) -> np.ndarray:
        """Stop lines in the colours that their lights show."""
        lines = self.road_map.network.lines.astype(float)
        shows = [program[seconds % len(program)] for program in self._programs]
        colour = np.array(paint.SIGNALS)[np.array(shows, dtype=int)]
        across = np.stack([-lines[:, 3], lines[:, 2]], axis=1)
        return self._shapes(self.pixel(lines[:, :2]), self._turn(across), lines[:, 4], 0.2, 0.0, colour, 1.0, 1.0)

    def _block_shapes(self) -> np.ndarray:
        """Parked cars, with the length and width of their blocks."""
        shapes = [np.zeros((0, paint.SHAPE), dtype=np.float32)]
        for x, y, turn, a, b in self._parked[self._near(self.pixel(self._parked[:, :2]), 8.0 * self.pixels_per_m)]:
            parts = paint.car_parts(2 * a, 2 * b, 0.62 * a, 0.62 * a, 0.0, paint.PARKED)
            shapes.append(self._placed(parts, np.array([[x, y]]), np.array([[math.cos(turn), math.sin(turn)]])))
        return np.concatenate(shapes)

    def _placed(self, parts: np.ndarray, positions: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """Shapes [v * k, 11] in pixels of a car's parts [k, 11] (units), for those v of n cars that are in view.

        The cars are at positions [n, 2] (units) with headings [n, 2] (cosine, sine).
        """
        scale = self.pixels_per_m
        at, along = self.pixel(positions), self._turn(headings)
        seen = self._near(at, 8.0 * scale)
        at, along = at[seen], along[seen]
        left = np.stack([along[:, 1], -along[:, 0]], axis=1)  # y is down
        turned = np.stack([along, left], axis=1)
        shapes = np.repeat(parts[None], len(at), axis=0)
        shapes[:, :, 0:2] = at[:, None] - 0.5 + scale * (parts[:, 0:2] @ turned)
        shapes[:, :, 2:4] = parts[:, 2:4] @ turned
        # At small scales, a car is still a visible dot.
        shapes[:, :, 4:7] *= max(scale, 2.0)
        return shapes.reshape(-1, paint.SHAPE)

    def _path_shapes(self, path: np.ndarray) -> np.ndarray:
        at = self.pixel(path)
        step, middle = at[1:] - at[:-1], (at[1:] + at[:-1]) / 2
        length = np.hypot(*step.T)
        far = 20.0 * self.pixels_per_m  # a longer step of the path crosses the torus's edge
        seen = (length > 0.01) & (length < far) & self._near(middle, far)
        step, middle, length = step[seen], middle[seen], length[seen]
        half = length / 2 / self.pixels_per_m + 0.12
        return self._shapes(middle, step / length[:, None], half, 0.12, 0.12, paint.PATH, 1.0, 0.7)

    def _ray_shapes(self, position: np.ndarray, heading: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        k = self._constants
        angle = k.ray_first + k.ray_step * np.arange(len(ranges))
        c, s = np.cos(angle), np.sin(angle)
        direction = np.stack([heading[0] * c - heading[1] * s, heading[1] * c + heading[0] * s], axis=1)
        front = float(k.front_axle) * self._per_m
        origin, along = self.pixel(position + front * heading), self._turn(direction)
        reach = along * ranges[:, None] * self.pixels_per_m
        rays = self._shapes(origin + reach / 2, along, ranges / 2, 0.04, 0.0, paint.RAY, 0.5)
        rays[:, 10] = np.maximum(rays[:, 10], 0.3)
        hit = ranges < float(k.ray_range) * self._per_m - 1e-3
        dots = self._shapes((origin + reach)[hit], along[hit], 0.22, 0.22, 0.22, paint.RAY, 1.0, 1.5)
        return np.concatenate([rays, dots])

    def _write(self, image: np.ndarray, text: str, corner: str) -> None:
        """Write a line of text on a dark pill into the upper or lower left corner."""
        height = self.size[1]
        edge, inner = height // 40, height // 56
        at = (edge + inner, edge + inner // 2 if corner == "upper" else height - edge - inner // 2)
        anchor, font = "la" if corner == "upper" else "ld", _font(max(11, round(height / 28)))
        picture = Image.fromarray(image)
        pen = ImageDraw.Draw(picture, "RGBA")
        left, top, right, bottom = pen.textbbox(at, text, font, anchor)
        pill = (left - inner, top - inner / 2, right + inner, bottom + inner / 2)
        pen.rounded_rectangle(pill, inner, (*paint.HUD, 184))
        pen.text(at, text, (245, 245, 245), font, anchor)
        image[:] = picture


@cache
def _font(pixels: int) -> Any:
    return ImageFont.load_default(pixels)


def interpolate(before: np.ndarray, after: np.ndarray, part: float, road_map: Map) -> np.ndarray:
    """Interpolate states float32 [CAR_FIELDS] or boxes [n, 4 or more] (x, y, cosine, sine) linearly, for pictures.

    Args: part in [0, 1] of the way from `before` to `after`, across the torus's edge if that is shorter.
    """
    gap = np.asarray(after, dtype=np.float64) - before
    gap[..., :2] = road_map.shortest(gap[..., :2])
    state = before + part * gap
    if road_map.torus:
        state[..., :2] = np.mod(state[..., :2], road_map.size)
    state[..., COS : SIN + 1] /= np.maximum(np.hypot(state[..., COS], state[..., SIN]), 1e-9)[..., None]
    return state.astype(np.float32)


class Window:
    """A window on a display, with its keys. A process may have several."""

    _open: ClassVar[dict[Any, Window]] = {}  # open windows by their `pygame.Window`, which events name

    def __init__(self, size: tuple[int, int], caption: str = "GridSim"):
        """Open the window. Raises: NoDisplayError; GridSimError if pygame is not installed."""
        check_extra("view")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self._pygame: Any = pygame
        chosen, wayland = os.environ.get("SDL_VIDEODRIVER"), os.environ.get("WAYLAND_DISPLAY")
        try:
            # SDL would also try drivers that need no display: they show nothing, and some print errors to stderr.
            if not has_display():
                raise pygame.error("no display")
            if sys.platform.startswith("linux") and not (chosen or wayland):
                os.environ["SDL_VIDEODRIVER"] = "x11"
            pygame.display.init()
            if not chosen and pygame.display.get_driver() in ("dummy", "offscreen", "evdev"):
                raise pygame.error("no display")
            self._window: Any = pygame.Window(caption, size)
        except pygame.error as error:
            self._quit_unused()
            raise NoDisplayError(
                f"no window can be opened ({error}): set DISPLAY to a running display, or work without a window"
            ) from error
        self._open[self._window] = self
        self._clock = pygame.time.Clock()
        self._pressed: set[str] = set()
        self.closed = False

    def show(self, image: np.ndarray, fps: float) -> None:
        """Show a picture uint8 [h, w, 3], and wait, so that at most `fps` pictures are shown in a second."""
        height, width = image.shape[:2]
        picture = self._pygame.image.frombuffer(np.ascontiguousarray(image), (width, height), "RGB")
        self._window.get_surface().blit(picture, (0, 0))
        self._window.flip()
        self._clock.tick(fps)

    def keys(self) -> tuple[set[str], set[str]]:
        """The keys pressed since the last call; and the same keys plus those of the arrows and space that are held now.

        Both are sets of pygame's names, such as "up", "space" and "escape". They are empty if this window is closed.
        Also closes each window that the user has asked to close.
        """
        pygame = self._pygame
        for event in pygame.event.get():  # pygame has one queue for all windows
            window = self._open.get(getattr(event, "window", None))
            if event.type == pygame.QUIT:
                for each in [*self._open.values()]:
                    each.close()
            elif window and event.type == pygame.WINDOWCLOSE:
                window.close()
            elif window and event.type == pygame.KEYDOWN:
                window._pressed.add(pygame.key.name(event.key))
        if self.closed:
            return set(), set()
        pressed, self._pressed = self._pressed, set()
        state = pygame.key.get_pressed()
        watched = {name for name in ("up", "down", "left", "right", "space") if state[pygame.key.key_code(name)]}
        return pressed, pressed | watched

    def close(self) -> None:
        if self._open.pop(self._window, None):
            self._window.destroy()
            self._quit_unused()
        self.closed = True

    def _quit_unused(self) -> None:
        """Leave the display if no window is open any more."""
        if not self._open:
            self._pygame.display.quit()
