"""What ``magtiles info`` prints of a log: its topics, and what to do with them next."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from magtiles.pipeline.output import print_json, print_table
from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from magtiles.stages.ingest.log.summary import LogSummary, TopicSummary


def run(path: Path, *, as_json: bool) -> int:
    """Print what the log holds. Raises UsageError without the extra, FormatError for a bad file."""
    try:
        from magtiles.stages.ingest.log.summary import summarize_log
    except ModuleNotFoundError as missing:
        raise UsageError(
            f"reading logs needs {missing.name}", remedy='pip install "magtiles[pipeline]"'
        ) from None
    summary = summarize_log(path)
    if as_json:
        print_json(summary)
    else:
        _print_summary(summary, path)
    return 0


def _print_summary(summary: LogSummary, path: Path) -> None:
    from magtiles.stages.ingest.log.summary import shown

    count = len(summary.topics)
    print(f"{path}: {summary.format}, {count} topic{'' if count == 1 else 's'}")
    if summary.truncated_at_byte is not None:
        print(f"truncated after byte {summary.truncated_at_byte}; this is what can be recovered")
    if not summary.topics:
        return
    print()
    rows = [
        (
            topic.topic,
            topic.schema or "-",
            str(topic.messages),
            "-" if topic.rate_hz is None else f"{topic.rate_hz:.4g}",
            _span(topic),
            topic.problem or shown(topic.first) or "-",
        )
        for topic in summary.topics
    ]
    unit = "s since boot" if summary.clock == "boot" else "UTC of recording"
    print_table(("topic", "schema", "messages", "Hz", f"span, {unit}", "first values"), rows)
    _print_next(summary, path)


def _span(topic: TopicSummary) -> str:
    if topic.start is None or topic.end is None:
        return "-"
    if isinstance(topic.start, float):
        return f"{topic.start:.3f} to {topic.end:.3f}"
    return f"{topic.start[:-6]} to {str(topic.end)[:-6]}"  # to milliseconds


def _print_next(summary: LogSummary, path: Path) -> None:
    magnetometers = [t for t in summary.topics if t.role == "magnetometer" and t.messages]
    if not magnetometers:
        print("\nno topic is a magnetometer's by its schema")
        return
    which = ""
    if len(magnetometers) > 1:
        which = f" --param 'magnetometer_topic=\"{magnetometers[0].topic}\"'"
    print(f"\nnext:\n  magtiles run ingest-log --in files={path} --out track.nc{which}")
