"""Figures of `benchmarks.study`."""

from pathlib import Path

from benchmarks.common.record import Row
from benchmarks.figures.canvas import plt, save

CURVES = {"one_demonstration": "trained on one demonstration", "panda7dof": "trained on 124"}  # drawn over time
Study = dict[str, list[Row]]


def draw(results: Study, out: Path) -> None:
    """The figure of the paper's second simulation, `OUT_unseen.png`, if there are results for it."""
    if all(f"{case}--unseen" in results for case in CURVES):
        _draw_unseen(results, out.with_name(out.name + "_unseen.png"))


def _draw_unseen(results: Study, out: Path) -> None:
    figure, axes = plt.subplots(figsize=(6, 3.8), layout="constrained")
    for (case, label), colour in zip(CURVES.items(), ("tab:orange", "tab:blue"), strict=True):
        curves = results[f"{case}--unseen"][0]["curves"]
        axes.plot(curves["time"], curves["mean"], color=colour, label=label)
        axes.fill_between(curves["time"], curves["low"], curves["high"], color=colour, alpha=0.2, lw=0)
        if case == "panda7dof":
            axes.plot(curves["time"], curves["hold"], ":", color="grey", label="holding the start pose")
    title = "32 unseen demonstrations, 7 to 7 joints: kinematic bound 0"
    axes.set(xlabel="time [s]", ylabel="embodiment distance", title=title, yscale="log", ylim=(1e-5, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    save(figure, out)
