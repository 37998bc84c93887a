"""The same cloud over peers: bare Zenoh, a put and a callback, and dora-rs. Run as a program, one end of it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import zenoh

from benchmarks.stations import POINTS, WARM_UP
from graph.transport import free_port

DATAFLOW = """
nodes:
  - id: maker
    path: {python}
    args: -m benchmarks.peers dora-maker {count}
    inputs: {{tick: dora/timer/millis/{period}}}
    outputs: [cloud]
  - id: meter
    path: {python}
    args: -m benchmarks.peers dora-meter {count} {out}
    inputs: {{cloud: maker/cloud}}
"""


def bytes_of_cloud() -> np.ndarray:
    """Draw what a cloud of the runtime holds: 1.2 MB of float32; seeded."""
    return np.random.default_rng(0).random(3 * POINTS, np.float32)


def _session(mode: str, endpoint: str) -> zenoh.Session:
    """Open Zenoh as it comes, but alone on this machine and with shared memory from the start."""
    config = zenoh.Config()
    side = "listen" if mode == "router" else "connect"
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5(f"{side}/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/mode", '"init"')
    return zenoh.open(config)


def zenoh_latencies(count: int, hertz: float) -> np.ndarray:
    """Send clouds client to router to client by plain puts, shared memory on. Returns (count,) in milliseconds."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with _session("router", endpoint):
        meter = _end("zenoh-meter", endpoint, str(count))
        assert meter.stdout is not None
        meter.stdout.readline()
        maker = _end("zenoh-maker", endpoint, str(count), str(hertz))
        latencies = json.loads(meter.stdout.readline())
        maker.kill()
        meter.wait(timeout=10)
        maker.wait(timeout=10)
    return np.array(latencies[WARM_UP:]) / 1e6


def dora_latencies(count: int, hertz: float) -> np.ndarray:
    """Send clouds from node to node of a dora dataflow. Returns (count,) in milliseconds. Raises RuntimeError."""
    dora = shutil.which("dora", path=str(Path(sys.executable).parent))
    if dora is None:
        raise RuntimeError('dora is not installed: pip install "retracer[bench]"')
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "latencies.json"
        text = DATAFLOW.format(python=sys.executable, count=count, period=round(1000 / hertz), out=out)
        (Path(folder) / "dataflow.yaml").write_text(text)
        command = [dora, "run", str(Path(folder) / "dataflow.yaml")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=count / hertz + 60, check=False)
        if not out.exists():
            raise RuntimeError(f"dora run failed: {(done.stdout + done.stderr)[-300:]}")
        return np.array(json.loads(out.read_text())[WARM_UP:]) / 1e6


def _end(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.peers", *arguments], stdout=subprocess.PIPE, text=True, bufsize=1
    )


def zenoh_meter(endpoint: str, count: int) -> None:
    """Receive clouds in the callback, as bytes, which is all that Zenoh gives a Python program."""
    latencies: list[int] = []
    full = threading.Event()

    def receive(sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        assert sample.attachment is not None
        latencies.append(time.monotonic_ns() - int.from_bytes(sample.attachment.to_bytes(), "little"))
        if len(latencies) == count:
            full.set()

    with _session("client", endpoint) as session:
        session.declare_subscriber("bench/cloud", zenoh.handlers.Callback(receive, indirect=False))
        print("ready", flush=True)
        full.wait()
        print(json.dumps(latencies), flush=True)


def zenoh_maker(endpoint: str, count: int, hertz: float) -> None:
    """Put clouds, the clock in the attachment."""
    data = bytes_of_cloud().tobytes()
    with _session("client", endpoint) as session:
        publisher = session.declare_publisher("bench/cloud", congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(0.5)
        for _ in range(count):
            publisher.put(data, attachment=time.monotonic_ns().to_bytes(8, "little"))
            time.sleep(1.0 / hertz)
        time.sleep(30)  # the other end may still read our memory


def dora_maker(count: int) -> None:
    """Send a cloud at each tick of dora's timer."""
    import pyarrow
    from dora import Node

    node, data = Node(), bytes_of_cloud()
    sent = 0
    for event in node:
        if event["type"] == "INPUT":
            node.send_output("cloud", pyarrow.array(data), {"at": time.monotonic_ns()})
            sent += 1
        if sent == count:
            break
    time.sleep(0.5)


def dora_meter(count: int, out: str) -> None:
    """Receive clouds as arrays and write down how old they are."""
    from dora import Node

    latencies: list[int] = []
    for event in Node():
        if event["type"] == "INPUT":
            event["value"].to_numpy(zero_copy_only=True).reshape(-1, 3)
            latencies.append(time.monotonic_ns() - event["metadata"]["at"])
        if event["type"] == "STOP" or len(latencies) == count:
            break
    Path(out).write_text(json.dumps(latencies))


if __name__ == "__main__":
    role, *rest = sys.argv[1:]
    if role == "zenoh-meter":
        zenoh_meter(rest[0], int(rest[1]))
    elif role == "zenoh-maker":
        zenoh_maker(rest[0], int(rest[1]), float(rest[2]))
    elif role == "dora-maker":
        dora_maker(int(rest[0]))
    else:
        dora_meter(int(rest[0]), rest[1])
