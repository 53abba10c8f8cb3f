"""What rmw_zenoh_cpp's nodes do, in zenoh's own words: the same key expressions, liveliness tokens and session settings.

over_zenoh.py serve WORK_S            services /plan and /secret, topics /pose and /secret_pose when an image comes
over_zenoh.py ask NAME [PATIENCE_S]   call a service, print the answers
over_zenoh.py publish                 an image on /image and on /secret_image, once a tenth of a second
over_zenoh.py listen SECONDS          print what comes on all topics
over_zenoh.py keep                    publish once on /pose and stay, as a transient-local publisher does
over_zenoh.py late SECONDS            print what was kept on /pose
over_zenoh.py graph                   print the liveliness tokens
over_zenoh.py plain ENDPOINT          whether a session to an endpoint opens
over_zenoh.py times COUNT BYTES       round trips of /plan with a payload, in seconds
"""

import json
import sys
import time

import zenoh

TYPE = "std_srvs::srv::dds_::Trigger_/RIHS01_eeff2cd6fbfe36a27c4e5fdd3e0ac3e5c1f2f0a49e1c0a1b2c3d4e5f60718293"
ROUTER = "tcp/127.0.0.1:7447"


def session() -> zenoh.Session:
    """A peer that waits for its router on loopback, as rmw_zenoh_cpp's default configuration says."""
    while True:
        try:
            return opened(ROUTER)
        except zenoh.ZError:
            time.sleep(0.2)


def opened(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer", "connect/endpoints": [endpoint], "listen/endpoints": ["tcp/localhost:0"],
        "scouting/multicast/enabled": False, "timestamping/enabled": True, "connect/timeout_ms": 3000,
        "connect/exit_on_failure": True, "transport/shared_memory/enabled": False,
    }.items():  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def key(name: str) -> str:
    return f"0/{name}/{TYPE}"


def serve(words: list[str]) -> None:
    with session() as here:
        poses = {name: here.declare_publisher(key(name)) for name in ("pose", "secret_pose")}

        def answer(query: zenoh.Query) -> None:
            time.sleep(float(words[0]))
            query.reply(query.key_expr, bytes(query.payload or b"") or b"planned")

        def look(sample: zenoh.Sample) -> None:
            for name, publisher in poses.items():
                publisher.put(f"{name} of {sample.payload.to_string()}")

        kept = [here.declare_queryable(key(name), answer) for name in ("plan", "secret")]
        kept += [here.declare_subscriber(key(name), look) for name in ("image", "secret_image")]
        kept.append(here.liveliness().declare_token(f"@ros2_lv/0/{here.info.zid()}/0/0/NN/%/%/planner"))
        print("up", flush=True)
        while True:
            time.sleep(1)


def asked(here: zenoh.Session, name: str, patience_s: float, payload: bytes = b"") -> list[bytes]:
    return [bytes(one.ok.payload) for one in here.get(key(name), timeout=patience_s, payload=payload) if one.ok]


def ask(words: list[str]) -> None:
    patience_s = float(words[1]) if len(words) > 1 else 2.0
    with session() as here:
        print(json.dumps([text.decode() for text in asked(here, words[0], patience_s)]))


def publish(words: list[str]) -> None:
    with session() as here:
        publishers = {name: here.declare_publisher(key(name)) for name in ("image", "secret_image")}
        while True:
            for name, publisher in publishers.items():
                publisher.put(name)
            time.sleep(0.1)


def listen(words: list[str]) -> None:
    found = set()
    with session() as here:
        for name in ("pose", "secret_pose", "image", "secret_image"):
            here.declare_subscriber(key(name), lambda sample: found.add(sample.payload.to_string()))
        here.declare_subscriber("**", lambda sample: found.add(sample.payload.to_string()))
        time.sleep(float(words[0]))
    print(json.dumps(sorted(found)))


def keep(words: list[str]) -> None:
    with session() as here:
        cache = zenoh.ext.CacheConfig(max_samples=1)
        publisher = zenoh.ext.declare_advanced_publisher(here, key("pose"), cache=cache, publisher_detection=True)
        publisher.put("kept")
        print("up", flush=True)
        while True:
            time.sleep(1)


def late(words: list[str]) -> None:
    found = set()
    with session() as here:
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        zenoh.ext.declare_advanced_subscriber(
            here, key("pose"), lambda sample: found.add(sample.payload.to_string()), history=history
        )
        time.sleep(float(words[0]))
    print(json.dumps(sorted(found)))


def graph(words: list[str]) -> None:
    with session() as here:
        tokens = [str(one.ok.key_expr) for one in here.liveliness().get("@ros2_lv/**", timeout=2.0) if one.ok]
        print(json.dumps([token.rpartition("/")[2] for token in tokens]))


def plain(words: list[str]) -> None:
    try:
        opened(words[0]).close()
        print(json.dumps("open"))
    except zenoh.ZError:
        print(json.dumps("refused"))


def times(words: list[str]) -> None:
    count, payload = int(words[0]), bytes(int(words[1]))
    took = []
    with session() as here:
        time.sleep(1)
        for _ in range(count + 5):
            begun = time.perf_counter()
            if [len(one) for one in asked(here, "plan", 10.0, payload or b"x")] != [len(payload) or 1]:
                sys.exit("no answer, or not what was sent")
            took.append(time.perf_counter() - begun)
    print(json.dumps(took[5:]))


if __name__ == "__main__":
    import zenoh.ext

    globals()[sys.argv[1]](sys.argv[2:])
