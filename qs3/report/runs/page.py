"""One page about one run: figures, pictures, settings. Nothing in it comes from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path

from qs3.evaluation.estimates_text import table as quality_table
from qs3.evaluation.selection_rules import chosen_in_words
from qs3.report.runs.data import RunFiles, settings_of
from qs3.report.runs.figures import EVALUATION_ONLY
from qs3.utils import html

_TITLES = {
    "curves": "Training",
    "confusion": "Confusion of classes",
    "pseudo_labels": "Pseudo-labels",
    "classes": "Balance of classes",
    "calibration": "Calibration",
    "embedding": "Features of both domains",
    "domains": "One object of each class",
    "source_clouds": "Clouds of the source",
    "target_clouds": "Clouds of the target",
    "class_balance": "Classes of both domains",
    "mistakes": "Most confident errors",
    "named": "Most confident of each class",
    "clouds": "Clouds to turn",
}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2430; margin: 2rem auto; padding: 0 1rem;
  max-width: 62rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
img { max-width: 100%; height: auto; }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; padding: .2rem .9rem .2rem 0;
  border-bottom: 1px solid #e3e6eb; }
th { font-weight: 500; color: #6b7482; }
pre { background: #f7f8fa; padding: .8rem; overflow-x: auto; font-size: 13px; }
.note { color: #8a5a12; }
"""


def page(
    run: RunFiles, pictures: Mapping[str, Path], skipped: Mapping[str, str], clouds: str = ""
) -> str:
    """The page as HTML, with its PNGs inside.

    Args:
        run: that it is of.
        pictures: PNGs by name.
        skipped: why a picture is not there, by name.
        clouds: the page beside it with clouds that can be turned, if there is one.
    """
    judged = run.final is not None and run.final.accuracy is not None
    order = "the most confident errors first" if judged else "in doubt first"
    link = f'<p><a href="{escape(clouds)}">Clouds to turn</a>, {order}.</p>'
    parts = [
        *(f'<p class="note">Note: {escape(note)}.</p>' for note in run.notes),
        html.table(key_figures(run).items(), head="column"),
        *([link] if clouds else []),
    ]
    if run.metrics is not None:
        quality = quality_table(run.metrics.quality)
        parts += ["<h2>Quality without labels</h2>", html.table(quality, head="column")]
    if run.command:
        parts += ["<h2>Command</h2>", f"<pre>{escape(run.command)}</pre>"]
    for name, path in pictures.items():
        words = _TITLES.get(name, name)
        parts += [f"<h2>{words}</h2>", html.image(path.read_bytes(), words)]
    if skipped:
        parts.append("<h2>Not drawn</h2><ul>")
        parts += [
            f"<li>{_TITLES.get(name, name)}: {escape(reason)}</li>"
            for name, reason in skipped.items()
        ]
        parts.append("</ul>")
    settings = settings_of(run)
    if settings:
        parts.append(
            f"<h2>Settings</h2><details><summary>all of them</summary>"
            f"<pre>{escape(settings)}</pre></details>"
        )
    return html.document(run.title, _STYLE, parts)


def key_figures(run: RunFiles) -> dict[str, str]:
    """What the page says first, in order."""
    if run.metrics is None:
        done = 0 if run.history is None else len(run.history.epoch)
        return {"status": "not finished", "epochs done": str(done)}
    m, final = run.metrics, run.metrics.final
    found = {
        "source": f"{m.source}, made of: {m.made_of.source}",
        "target": f"{run.target}, made of: {m.made_of.target}",
        "method": m.method,
        "self-training": m.selftraining,
        "model": m.model,
    }
    if final.accuracy is None:
        found["accuracy"] = "not known: the target has no labels"
    else:
        found["accuracy"] = f"{final.accuracy:.1%}"
        found["balanced accuracy"] = f"{final.balanced_accuracy:.1%}"
        found["majority rate"] = f"{final.majority_rate:.1%}"
    if final.calibration_error is not None:
        found["expected calibration error"] = f"{final.calibration_error:.1%} ({EVALUATION_ONLY})"
    found["clouds evaluated"] = str(final.n)
    before = m.warmup.selected.scores.accuracy
    if run.rounds and before is not None:
        found["accuracy before self-training"] = f"{before:.1%}"
    found["teacher selected by"] = chosen_in_words(m.selection.teacher)
    if run.rounds:
        found["student selected by"] = chosen_in_words(m.selection.student)
    found["time"] = f"{m.times.seconds:.0f} s"
    found["hash of the settings"] = m.hash
    found["versions"] = ", ".join(f"{k} {v}" for k, v in m.versions.items())
    return found
