"""The end of a report: what the arms cost, how they differ, how they were evaluated."""

from . import configs, numbers
from .contents import Content, Report
from .markup import details, duration, listed, number, plural, table, tag


def cost(report: Report) -> Content:
    """Hours, and speed beside the baseline's."""
    body = []
    for game in report.games:
        for row in numbers.costs(report.of(game), report.arms, report.baseline):
            cells = [f"{game} / {row.arm}", row.runs, duration(row.hours), duration(row.per_run)]
            cells += [number(row.speed, 0), "–" if row.relative is None else f"{number(row.relative)} times"]
            body.append([*cells, f"encoder of {row.source}" if row.source else ""])
    head = ["arm", "runs", "time in all", "time a run", "env steps/s", "time per env step", "starts from"]
    if sourced := any(row[-1] for row in body):
        body = [[*row[:-1], row[-1] or "–"] for row in body]
    else:
        head, body = head[:-1], [row[:-1] for row in body]
    note = (
        "Times by the runs' own clocks, evaluations included; what else ran on the machine slows a run down. "
        "Env steps/s is the median over rows of training. "
    )
    if report.baseline:
        note += f"The time per env step is a multiple of {report.baseline}'s. "
    if sourced:
        note += "An arm that starts from another one's encoder costs that run as well."
    return [table(head, body, "Time and cost of each arm"), tag("p", note, class_="note")]


def settings(report: Report) -> Content:
    """Every difference between the arms, game by game; what all share behind it."""
    differing, shared = configs.settings(report.runs, report.arms)
    parts: list = []
    for games, arms, fields in differing:
        parts.append(tag("h3", f"{listed(games)}: in what the arms differ"))
        if fields:
            body = [[name, *values] for name, values in fields]
            parts.append(table(("field", *arms), body, f"Settings on {listed(games)}", "settings"))
        else:
            parts.append(tag("p", "In no setting." if len(arms) > 1 else "There is one arm."))
    body = [[name, value] for name, value in shared]
    more = table(("field", "value"), body, "Settings that all arms share", "settings")
    return [*parts, details(f"What all arms of a game share: {plural(len(shared), 'field')}", more)]


def protocol(report: Report) -> Content:
    """How policies were evaluated, and what was compared though it differs."""
    parts: list = []
    if report.forced:
        items = [tag("li", line) for line in report.forced]
        why = tag("strong", "Compared by force (--force), though these differ:")
        parts.append(tag("div", why, tag("ul", items), class_="warn"))
    for game in report.games:
        played = [run.config for run in report.of(game) if numbers.has_policy(run)]
        texts = dict.fromkeys(configs.protocol_text(config) for config in played)
        parts += [tag("p", tag("strong", game), f": {text}.") for text in texts]
    return parts or None
