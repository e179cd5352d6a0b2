"""Plot of the certificates of a data set: errors of the hand, margins and speeds over time."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mimic.retargeting.certificate import POSITION, ROTATION, Certificate

_COLOURS = {True: "tab:blue", False: "tab:red"}  # of episodes that are ok and of those that fail


def plot_certificates(certificates: Mapping[str, Certificate], dt: float, out: Path, title: str) -> None:
    """Plots the frames of all episodes: the hand's errors, the smallest margin, the speed; bounds are dashed.

    Args:
      certificates: by episode.
      dt: time between two frames [s].
      out: file of the plot.
      title: title of the plot.
    """
    panels = (
        ("hand [mm]", lambda item: 1e3 * item.position, 1e3 * POSITION, True),
        ("hand [deg]", lambda item: np.degrees(item.rotation), np.degrees(ROTATION), True),
        ("margin to the joint ranges [deg]", lambda item: np.degrees(item.margin), 0.0, False),
        ("fraction of the velocity limits", lambda item: item.speed, 1.0, False),
    )
    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for axis, (label, values, bound, is_logarithmic) in zip(axes.ravel(), panels, strict=True):
        for is_ok, colour in _COLOURS.items():
            own = [np.append(values(item), np.nan) for item in certificates.values() if item.is_ok == is_ok]
            time = [dt * np.arange(len(shown)) for shown in own]
            if own:  # one line, which is interrupted after each episode
                shown = np.concatenate(own)
                shown = np.maximum(shown, 1e-6) if is_logarithmic else shown
                axis.plot(np.concatenate(time), shown, color=colour, lw=0.7, alpha=0.6)
        axis.axhline(bound, color="black", lw=0.8, ls="--")
        axis.set_yscale("log" if is_logarithmic else "linear")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    fails = sum(not item.is_ok for item in certificates.values())
    figure.suptitle(f"{title}: {len(certificates)} episodes, {fails} fail (red)")
    figure.savefig(out, dpi=120)
