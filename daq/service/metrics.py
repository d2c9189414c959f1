"""Counters in Prometheus' text form: few, with bounded labels, read without stopping anything."""

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping

BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
Gauge = Callable[[], Mapping[str, float] | float]


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


class Metrics:
    """Request counts and times, and gauges that are asked when somebody looks."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requests: dict[tuple[str, str, int], int] = defaultdict(int)
        self._times: dict[str, list[float]] = defaultdict(lambda: [0.0] * (len(BUCKETS_S) + 2))
        self._gauges: dict[str, tuple[str, str, str, Gauge]] = {}

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request; `route` is the pattern, never the path, to bound the labels."""
        with self._lock:
            self._requests[(method, route, status)] += 1
            row = self._times[route]
            for index, edge in enumerate(BUCKETS_S):
                row[index] += seconds <= edge
            row[-2] += 1
            row[-1] += seconds

    def gauge(
        self, name: str, text: str, read: Gauge, label: str = "", kind: str = "gauge"
    ) -> None:
        """Show `read()` under `name`; a mapping becomes one line for each value of `label`."""
        self._gauges[name] = (text, label, kind, read)

    def render(self) -> str:
        """The page that Prometheus reads."""
        out = [
            "# HELP entrain_requests_total Requests answered.",
            "# TYPE entrain_requests_total counter",
        ]
        with self._lock:
            requests, times = dict(self._requests), {k: list(v) for k, v in self._times.items()}
        for (method, route, status), count in sorted(requests.items()):
            labels = f'method="{_escape(method)}",route="{_escape(route)}",status="{status}"'
            out.append(f"entrain_requests_total{{{labels}}} {count}")
        out += [
            "# HELP entrain_request_seconds Time to answer.",
            "# TYPE entrain_request_seconds histogram",
        ]
        for route, row in sorted(times.items()):
            name = f'route="{_escape(route)}"'
            for edge, below in zip(BUCKETS_S, row, strict=False):
                out.append(f'entrain_request_seconds_bucket{{{name},le="{edge:g}"}} {below:.15g}')
            out.append(f'entrain_request_seconds_bucket{{{name},le="+Inf"}} {row[-2]:.15g}')
            out.append(f"entrain_request_seconds_sum{{{name}}} {row[-1]:.6f}")
            out.append(f"entrain_request_seconds_count{{{name}}} {row[-2]:.15g}")
        for gauge, (text, label, kind, read) in self._gauges.items():
            out += [f"# HELP {gauge} {text}", f"# TYPE {gauge} {kind}"]
            value = read()
            if isinstance(value, Mapping):
                out += [f'{gauge}{{{label}="{_escape(k)}"}} {v:.15g}' for k, v in value.items()]
            else:
                out.append(f"{gauge} {value:.15g}")
        return "\n".join(out) + "\n"
