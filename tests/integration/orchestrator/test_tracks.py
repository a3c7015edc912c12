"""``muster tracks`` as a person uses it, on the store of a real controller."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from shared_store.layout import Store
from tests.conftest import Serving, call_muster
from worker.racer.naming import resolve


def test_tracks_are_made_imported_drawn_and_listed(shared_server: Serving, tmp_path: Path) -> None:
    home, picture, file = shared_server.home, tmp_path / "hills.png", tmp_path / "hills.npy"
    store = Store(shared_server.client.get("/api/capacity")["store"])

    def refused(*arguments: str) -> str:
        done = call_muster("tracks", *arguments, home=home)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
        return done.stderr

    made = call_muster("tracks", "make", "hills", "--seed", "7", "--length", "40", "-o", str(picture), home=home)
    assert made.returncode == 0, made.stderr
    assert "hills: 40.00 m long, 1.00 m wide, counter-clockwise" in made.stdout and "seed 7, length 40" in made.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    track = resolve("hills", store)
    assert len(track.center) == round(40 / 0.15)

    assert "hills exists already, and tracks are immutable" in refused("make", "hills", "--seed", "8")
    assert "give one of --preset" in refused("make", "both", "--seed", "8", "--preset", "oval")
    assert "--roughness belongs to --seed" in refused("make", "x", "--preset", "oval", "--roughness", "1")
    assert "did you mean hills?" in refused("show", "hils")
    assert "it exists; --overwrite replaces it" in refused("show", "hills", "-o", str(picture))
    assert "unknown ending; use one of .png, .npy" in refused("show", "hills", "-o", str(tmp_path / "hills.gif"))

    shown = call_muster("tracks", "show", "hills", "-o", str(file), "--json", home=home)
    assert json.loads(shown.stdout)["digest"] == track.digest
    rows = np.load(file, allow_pickle=False)
    np.testing.assert_array_equal(rows, track.rows())

    np.save(tmp_path / "swapped.npy", rows[:, [0, 1, 4, 5, 2, 3]])
    swapped = call_muster("tracks", "import", str(tmp_path / "swapped.npy"), "--name", "copy", home=home)
    assert swapped.returncode == 0 and "mended:     the borders were swapped" in swapped.stdout, swapped.stderr
    rows[9] = np.nan
    np.save(tmp_path / "broken.npy", rows)
    said = refused("import", str(tmp_path / "broken.npy"), "--name", "broken")
    assert f"{tmp_path}/broken.npy: centre line: row 9" in said

    (store.tracks / "copy" / "manifest.json").unlink()
    listed = json.loads(call_muster("tracks", "list", "--json", home=home).stdout)
    assert [each["name"] for each in listed] == ["oval", "rounded-rectangle", "chicane", "copy", "hills"]
    assert "copy is damaged" in listed[3]["problem"] and listed[4]["origin"] == {"seed": 7, "length": 40.0}
    assert "track copy is damaged" in refused("show", "copy")
