from __future__ import annotations

import json
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs

import pytest

from geofleet.errors import ConfigError, InputError
from geofleet.formats.osm import read_lanes, read_signs
from geofleet.formats.osm_online import cache_folder, fetch, parse_bbox

# Answers in the form of Nominatim and Overpass, for a corner of Compiègne.
PLACE = [
    {
        "place_id": 1,
        "osm_type": "relation",
        "osm_id": 1,
        "lat": "49.41",
        "lon": "2.82",
        "display_name": "Compiègne, Oise, France",
        "class": "boundary",
        "type": "administrative",
        "importance": 0.6,
        "boundingbox": ["49.40", "49.42", "2.81", "2.83"],
        "geojson": {
            "type": "Polygon",
            "coordinates": [[[2.81, 49.40], [2.83, 49.40], [2.83, 49.42], [2.81, 49.42], [2.81, 49.40]]],
        },
    }
]
ELEMENTS = [
    {"type": "node", "id": 1, "lat": 49.41, "lon": 2.82},
    {"type": "node", "id": 2, "lat": 49.411, "lon": 2.82},
    {"type": "node", "id": 3, "lat": 49.4105, "lon": 2.8201, "tags": {"traffic_sign": "FR:AB4", "direction": "180"}},
    {"type": "node", "id": 4, "lat": 49.4106, "lon": 2.8201, "tags": {"traffic_sign": "FR:B14[30]", "note": "é"}},
    {"type": "way", "id": 7, "nodes": [1, 2], "tags": {"highway": "residential", "maxspeed": "30"}},
]


class Replay(BaseHTTPRequestHandler):
    asked: list[str]

    def do_GET(self):
        self.answer(PLACE if "nowhere" not in self.path else [])

    def do_POST(self):
        query = parse_qs(self.rfile.read(int(self.headers["Content-Length"])).decode())["data"][0]
        self.answer({"version": 0.6, "generator": "Overpass API", "elements": ELEMENTS}, query)

    def answer(self, content, query=""):
        self.asked.append(query or self.path)
        body = json.dumps(content).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    handler = type("Handler", (Replay,), {"asked": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as replay:
        thread = threading.Thread(target=replay.serve_forever)
        thread.start()
        url = f"http://127.0.0.1:{replay.server_port}"
        monkeypatch.setenv("GEOFLEET_OVERPASS_URL", f"{url}/api")
        monkeypatch.setenv("GEOFLEET_NOMINATIM_URL", f"{url}/")
        yield handler
        replay.shutdown()
        thread.join()


def test_a_place_becomes_signs_and_lanes_and_is_asked_for_once(server, tmp_path):
    resolve = socket.getaddrinfo
    path = fetch(place="Compiègne, France", cache=tmp_path)
    assert socket.getaddrinfo is resolve
    rows = read_signs(path).table.to_pylist()
    assert [(r["sign_id"], r["sign_class"], r["country"], r["facing_deg"], r["road_id"]) for r in rows] == [
        ("n3-0", "stop", "FR", 180.0, "w7"),
        ("n4-0", "speed_limit:30", "FR", pytest.approx(180.0, abs=0.1), "w7"),
    ]
    assert read_lanes(path).table["speed_limit_kmh"].to_pylist() == [30.0]
    n_asked = len(server.asked)
    assert n_asked == 2
    assert "traffic_sign" in server.asked[1]
    assert fetch(place="Compiègne, France", cache=tmp_path) == path
    assert len(server.asked) == n_asked


def test_a_box_is_asked_for_without_a_name(server, tmp_path):
    path = fetch(bbox=(2.81, 49.40, 2.83, 49.42), cache=tmp_path)
    assert read_signs(path).table.num_rows == 2
    assert len(server.asked) == 1


def test_an_unknown_place_is_told(server, tmp_path):
    with pytest.raises(InputError, match="nothing for 'nowhere at all'"):
        fetch(place="nowhere at all", cache=tmp_path)
    assert server.asked
    assert not list(tmp_path.glob("*.json"))


def test_offline_says_what_to_do(monkeypatch, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}"
    monkeypatch.setenv("GEOFLEET_OVERPASS_URL", f"{url}/api")
    monkeypatch.setenv("GEOFLEET_NOMINATIM_URL", f"{url}/")
    with pytest.raises(
        InputError, match=r"cannot be asked for 'Compiègne, France'.*no connection.*give a file instead"
    ):
        fetch(place="Compiègne, France", cache=tmp_path)


def test_the_cache_folder_can_be_chosen(monkeypatch, tmp_path):
    monkeypatch.setenv("GEOFLEET_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("GEOFLEET_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "geofleet"


@pytest.mark.parametrize("text", ["1,2,3", "a,b,c,d", "3,1,2,4", "0,0,200,1", "nan,0,1,1", ""])
def test_a_box_that_is_none_is_refused(text):
    with pytest.raises(ConfigError, match="--bbox"):
        parse_bbox(text)


def test_a_place_or_a_box_but_not_both():
    with pytest.raises(ConfigError, match="either"):
        fetch()
    with pytest.raises(ConfigError, match="either"):
        fetch(place="x", bbox=(0, 0, 1, 1))
