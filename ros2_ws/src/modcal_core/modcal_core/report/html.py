"""The report as one page that needs nothing else: no scripts, no files beside it, no network."""

from __future__ import annotations

from modcal_core.report.figures import effect_shapes, error_by_joint, error_histogram
from modcal_core.report.report import STAGES, Report, to_json_data

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ data.title }}: calibration report</title>
<style>
  :root { color-scheme: light; --ink: #1c2430; --soft: #5b6675; --line: #dde2e9; --good: #1f6feb; }
  body { font: 16px/1.55 system-ui, sans-serif; color: var(--ink); max-width: 60rem; margin: 2.5rem auto; padding: 0 1.2rem; }
  h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2.2rem; }
  .verdict { font-size: 1.15rem; border-left: 4px solid var(--good); padding: .4rem 1rem; background: #f5f8fd; }
  table { border-collapse: collapse; } th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); text-align: left; }
  td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
  .soft { color: var(--soft); } svg { max-width: 100%; height: auto; } .wide { overflow-x: auto; }
</style>
</head>
<body>
<h1>{{ data.title }}</h1>
<p class="verdict">{{ data.verdict }}</p>
<h2>Error on held-out {{ data.split.unit }}s</h2>
<table>
<tr><th>model</th><th class="n">mean, mm</th><th class="n">RMS, mm (95 % interval)</th><th class="n">95 %, mm</th><th class="n">max, mm</th>
{% if data.error_deg.nominal %}<th class="n">RMS, deg</th>{% endif %}</tr>
{% for stage in stages if data.error_mm[stage] %}
<tr><td>{{ stage }}</td>{% for k in ("mean", "rms", "p95", "max") %}
<td class="n">{{ "%.3f"|format(data.error_mm[stage][k]) }}{% if k == "rms" and data.error_mm[stage].rms_ci95 %}
&nbsp;<span class="soft">({{ "%.3f … %.3f"|format(*data.error_mm[stage].rms_ci95) }})</span>{% endif %}</td>{% endfor %}
{% if data.error_deg[stage] %}<td class="n">{{ "%.4f"|format(data.error_deg[stage].rms) }}</td>{% endif %}</tr>
{% endfor %}
</table>
<p class="soft">Noise floor: {{ "%.3f mm"|format(data.noise_floor_mm) if data.noise_floor_mm is not none else "not shown by this recording" }}.
{{ data.recording.stations }} stations ({{ data.recording.measurement }}), {{ data.recording.rejected }} rejected;
{{ data.split.train }} to fit, {{ data.split.explain }} to choose effects, {{ data.split.held_out }} to score.</p>
{{ histogram|safe }}
{% if by_joint %}<h2>What is left, joint by joint</h2>
<p class="soft">A pattern in one of these is an effect that the model lacks.</p><div class="wide">{{ by_joint|safe }}</div>{% endif %}
{% if data.effects %}
<h2>What the model lacked</h2>
{% for sentence in data.story %}<p>{{ sentence }}</p>
{% endfor %}
<div class="wide"><table>
<tr><th>effect</th><th>place</th><th>direction</th><th>driver</th><th>sizes</th><th class="n">p</th><th class="n">RMS before, mm</th>
<th class="n">after, mm</th><th>or</th></tr>
{% for e in data.effects %}
<tr><td>{{ e.family }}</td><td>{{ e.place }}</td><td>{{ e.direction }}</td><td>{{ e.driver }}</td>
<td>{% for name, q in e.parameters.items() %}{{ name }} {{ "%.4g"|format(q.value) }} ± {{ "%.1g"|format(q.std) }} {{ q.unit if q.unit != "1" }}<br>{% endfor %}</td>
<td class="n">{{ "%.1g"|format(e.p_value) }}</td><td class="n">{{ "%.3f"|format(e.rms_mm_before) }}</td>
<td class="n">{{ "%.3f"|format(e.rms_mm_after) }}</td><td>{{ e.same_as|join("; ") }}</td></tr>
{% endfor %}
</table></div>
{% if shapes %}<p class="soft">Shapes over the joints' positions, with two standard deviations.</p><div class="wide">{{ shapes|safe }}</div>{% endif %}
{% endif %}
{% if data.identifiability %}
<h2>What the data could tell</h2>
<p>{{ data.identifiability.parameters }} parameters, rank {{ data.identifiability.rank }}{% if data.identifiability.condition %},
condition {{ "%.0f"|format(data.identifiability.condition) }}{% endif %}.
{% if data.identifiability.unobservable %}Not shown by these stations, held near nominal:{% endif %}</p>
{% if data.identifiability.unobservable %}<ul>{% for name in data.identifiability.unobservable %}<li>{{ name }}</li>{% endfor %}</ul>{% endif %}
{% endif %}
{% if data.parameters %}
<h2>Parameters</h2>
<div class="wide"><table>
<tr><th>name</th><th class="n">value</th><th class="n">std</th><th>unit</th></tr>
{% for p in data.parameters %}
<tr><td>{{ p.name }}</td><td class="n">{{ "%.4f"|format(1e3 * p.value) }}</td><td class="n">{{ "%.4f"|format(1e3 * p.std) }}</td>
<td>{{ {"m": "mm", "rad": "mrad", "1": "‰"}.get(p.unit, p.unit) }}</td></tr>
{% endfor %}
</table></div>
{% endif %}
{% if data.notes %}<h2>Notes</h2><ul>{% for note in data.notes %}<li>{{ note }}</li>{% endfor %}</ul>{% endif %}
</body>
</html>
"""


def to_html(report: Report) -> str:
    """The report as HTML text."""
    from jinja2 import Environment

    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(_PAGE)
    return page.render(
        data=to_json_data(report),
        stages=STAGES,
        histogram=error_histogram(report),
        by_joint=error_by_joint(report),
        shapes=effect_shapes(report),
    )
