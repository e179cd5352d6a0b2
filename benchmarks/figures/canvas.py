"""matplotlib without a display, and saving of figures."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402


def save(figure: Any, out: Path) -> None:
    figure.savefig(out, dpi=150)
    plt.close(figure)
