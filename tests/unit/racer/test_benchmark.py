"""The table of the racer's benchmark."""

from __future__ import annotations

from benchmarks import racer


def test_the_racers_table_tells_when_a_car_first_drove_a_lap_and_how_fast_it_is_in_the_end() -> None:
    at = {"seconds": 2.0, "cpu_seconds": 3.0, "env_steps": 400_000, "iteration": 4}
    curve = [{**at, "seconds": 1.0, "laps": 0, "progress": None}, {**at, "laps": 2, "progress": 50.0}]
    early = {**at, "share": 0.5, "lap_times": {"oval": [9.0], "chicane": []}}
    last = {**at, "seconds": 7.0, "share": 0.75, "lap_times": {"oval": [9.0, 10.0], "chicane": [20.0]}}
    row = {
        **{"task": "Racer", "cuda": False, "cores": 2, "worlds": 128, "wanted": 0.5, "judged_worlds": 4},
        **{"training_rate": 1000.0, "simulation_rate": 150_000.0, "curve": curve, "judged": [early, last]},
        "done": early,
    }
    output = racer.table([row])
    assert "| 128 | 2.0 s (3 s of processors), 0.40 M steps | 2.0 s (3 s" in output
    assert "| 75.0 % | 1,000 steps/s | 150,000 cars · steps/s | 10,000 |" in output  # 150,000 / 15
    assert "| oval | 2 of 2 | 9.00 | 9.50 |" in output and "| chicane | 1 of 2 | 20.00 | 20.00 |" in output
    assert "| no | 7.0 s" in racer.table([{**row, "done": None}])
