"""Draws definitions.png, the figure of definitions.md: `python docs/draw_definitions.py`."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, Rectangle

INK, BODY, AXIS, LIGHT = "#222222", "#1f6fb4", "#c0392b", "#b9c4cf"
PSI, TILT = math.radians(38), math.radians(24)  # far larger than real, to be seen


def arrow(
    ax: Axes, start: tuple[float, float], end: tuple[float, float], color: str, width: float = 1.6
) -> None:
    ax.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": "-|>", "color": color, "lw": width, "shrinkA": 0, "shrinkB": 0},
    )


def top_view(ax: Axes) -> None:
    """Along the optical axis: field, body, origin, dx, dy, psi."""
    ax.set_title("along the optical axis, as on the sensor", fontsize=10)
    ax.add_patch(Rectangle((-1.3, -1.3), 2.6, 2.6, fill=False, ec=INK, lw=1))
    ax.text(-1.27, -1.36, "field of the camera", fontsize=9, color=INK)
    reference, now = np.array([0.15, -0.1]), np.array([0.5, 0.22])
    for centre, turn, color, style in ((reference, 0.0, LIGHT, "--"), (now, PSI, BODY, "-")):
        ax.add_patch(Circle(tuple(centre), 1.55, fill=False, ec=color, ls=style, lw=1.4))
        for angle, name in ((0.0, "x"), (math.pi / 2, "y")):
            tip = centre + 0.95 * np.array([math.cos(angle + turn), math.sin(angle + turn)])
            arrow(ax, tuple(centre), tuple(tip), color)
            if color == BODY:
                ax.text(*(tip + 0.07), f"{name} body", color=color, fontsize=9)
    random = np.random.default_rng(4)
    for radius, angle in zip(1.45 * np.sqrt(random.random(26)), random.uniform(0, math.tau, 26), strict=True):
        for centre, turn, color in ((reference, 0.0, LIGHT), (now, PSI, BODY)):
            ax.plot(
                *(centre + radius * np.array([math.cos(angle + turn), math.sin(angle + turn)])),
                ".",
                color=color,
                ms=4,
            )
    ax.add_patch(Arc(tuple(now), 1.3, 1.3, theta1=0, theta2=math.degrees(PSI), color=AXIS, lw=1.5))
    ax.plot([now[0], now[0] + 0.95], [now[1], now[1]], ":", color=AXIS, lw=1)
    ax.text(now[0] + 0.7, now[1] + 0.32, r"$\psi$", color=AXIS, fontsize=13)
    corner = (now[0], reference[1])
    arrow(ax, tuple(reference), corner, AXIS)
    arrow(ax, corner, tuple(now), AXIS)
    ax.text(0.24, reference[1] - 0.06, "dx", color=AXIS, fontsize=11)
    ax.text(now[0] + 0.05, 0.1, "dy", color=AXIS, fontsize=11)
    ax.plot(*now, "o", color=BODY, ms=5)
    ax.annotate(
        "origin: centre of rotation,\nfixed to the body", tuple(now), (-1.55, 1.72),
        fontsize=9, color=BODY, ha="left", arrowprops={"arrowstyle": "-", "color": BODY, "lw": 0.7},
    )  # fmt: skip
    ax.text(0.2, -0.95, "reference pose", fontsize=9, color="#8794a0")
    base = (-2.1, -1.3)
    arrow(ax, base, (base[0] + 0.45, base[1]), INK)
    arrow(ax, base, (base[0], base[1] + 0.45), INK)
    ax.text(base[0], base[1] - 0.1, "x (columns)", fontsize=9)
    ax.text(base[0] - 0.05, base[1] + 0.62, "y (rows)", fontsize=9)
    ax.text(base[0] - 0.05, base[1] + 0.85, "z into the page", fontsize=9)
    ax.set_xlim(-2.3, 2.25)
    ax.set_ylim(1.95, -1.75)  # y down, as on the sensor; psi turns from x to y
    ax.set_aspect("equal")
    ax.axis("off")


def tilt_view(ax: Axes) -> None:
    """In perspective: swing vector, axis of the body, alpha, beta."""
    ax.set_title("tilt (greatly enlarged)", fontsize=10)
    alpha = math.radians(35)

    def project(x: float, y: float, z: float) -> np.ndarray:
        return np.array([0.94 * x - 0.42 * y, 0.30 * x + 0.38 * y + z])

    def line(points: np.ndarray, color: str, width: float = 1.3, style: str = "-") -> None:
        ax.plot(*np.array([project(*point) for point in points]).T, color=color, lw=width, ls=style)

    turn = np.linspace(0, math.tau, 120)
    axis = np.array([math.sin(TILT) * math.cos(alpha), math.sin(TILT) * math.sin(alpha), math.cos(TILT)])
    swing = np.array([-math.sin(alpha), math.cos(alpha), 0.0])
    side = np.cross(swing, axis)
    line(np.array([[math.cos(t), math.sin(t), 0.0] for t in turn]), LIGHT, 1.2, "--")
    line(np.array([math.cos(t) * swing + math.sin(t) * side for t in turn]), BODY, 1.6)
    for end, name in (((1.35, 0, 0), "x"), ((0, 1.5, 0), "y"), ((0, 0, 1.5), "z")):
        arrow(ax, tuple(project(0, 0, 0)), tuple(project(*end)), INK)
        ax.text(*([*project(*(1.06 * np.array(end))), 0.0, 0.0]), name, fontsize=11)
    arrow(ax, tuple(project(0, 0, 0)), tuple(project(*(1.45 * axis))), BODY, 2)
    ax.text(
        *([*project(*(1.4 * axis)), 0.08, -0.12]), "axis of the body\n$n = R\\,z$", color=BODY, fontsize=10
    )
    arrow(ax, tuple(project(0, 0, 0)), tuple(project(*(0.95 * swing))), AXIS, 2)
    ax.text(
        *([*project(*(1.0 * swing)), -0.55, 0.1]), "swing vector\n(tilt_x, tilt_y)", color=AXIS, fontsize=10
    )
    line(
        np.array(
            [
                0.9 * np.array([math.sin(b) * math.cos(alpha), math.sin(b) * math.sin(alpha), math.cos(b)])
                for b in np.linspace(0, TILT, 30)
            ]
        ),
        AXIS,
    )
    ax.text(*([*project(0.2, 0.12, 0.98), -0.03, 0.02]), r"$\beta$", color=AXIS, fontsize=13)
    shadow = np.array([axis[0], axis[1], 0.0]) / math.sin(TILT)
    line(np.array([[0, 0, 0], 0.85 * shadow]), AXIS, 1, ":")
    line(np.array([1.45 * axis, 1.45 * np.array([axis[0], axis[1], 0.0])]), AXIS, 0.8, ":")
    line(
        np.array([0.55 * np.array([math.cos(a), math.sin(a), 0.0]) for a in np.linspace(0, alpha, 30)]), AXIS
    )
    ax.text(*([*project(0.62, 0.12, 0.0), 0.0, -0.02]), r"$\alpha$", color=AXIS, fontsize=13)
    ax.set_xlim(-1.6, 1.75)
    ax.set_ylim(-0.75, 1.75)
    ax.set_aspect("equal")
    ax.axis("off")


def main() -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5.2))
    top_view(left)
    tilt_view(right)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("definitions.png"), dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
