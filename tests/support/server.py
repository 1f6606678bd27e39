"""An odometry that runs on, as one written in any language might: no more than the protocol.

Drives `speed` metres along x with every scan, and goes wrong at the third where it is told to.
"""

import json
import struct
import sys
import time

SPACE = {"speed": {"type": "float", "low": 0.0, "high": 9.0, "baseline": 1.0, "log": False}}


def receive(stream):
    (length,) = struct.unpack("<I", stream.read(4))
    header = json.loads(stream.read(length))
    arrays = {}
    for name, kind, shape in header["arrays"]:
        size = int(kind[-1])
        for n in shape:
            size *= n
        arrays[name] = stream.read(size)
    return header, arrays


def send(stream, header, pose=None, columns=4):
    header["arrays"] = [] if pose is None else [["pose", "<f8", [4, columns]]]
    encoded = json.dumps(header).encode()
    stream.write(struct.pack("<I", len(encoded)) + encoded)
    if pose is not None:
        stream.write(struct.pack("<16d", *pose))
    stream.flush()


def main(fault="none"):
    reader, writer = sys.stdin.buffer, sys.stdout.buffer
    parameters, pose, n = {"speed": 1.0}, [0.0] * 16, 0
    while True:
        header, arrays = receive(reader)
        kind = header["type"]
        if kind == "hello":
            parameters |= header["parameters"]
            version = 1 if fault == "version" else header["version"]
            answer = {"type": "done", "version": version, "live": True, "odometry": "server"}
            send(writer, answer | ({} if fault == "space" else {"space": SPACE}))
        elif kind == "register":
            n += 1
            until = time.process_time() + (0.05 if fault == "works" else 0.0)
            while time.process_time() < until:
                pass
            pose[3] += parameters["speed"]
            stamp = header["stamp"]
            if n == 3:
                go_wrong(fault, writer)
                stamp -= 200_000_000 if fault == "backwards" else 0
            answer = {"type": "pose", "stamp": stamp, "registered": True}
            if n == 3 and fault == "types":
                answer["stamp"] = "now"
            if n == 3 and fault == "fault":
                answer = {"type": "fault"}
            columns = 4 * 10**12 if n == 3 and fault == "shape" else 4
            send(writer, answer, None if n == 3 and fault == "no pose" else pose, columns)
        else:
            if kind == "start":
                pose, n = list(struct.unpack("<16d", arrays["pose"])), 0
            parameters |= header.get("parameters", {})
            send(writer, {"type": "done"})


def go_wrong(fault, writer):
    sys.stderr.write("about to go wrong\n")
    if fault == "exit":
        sys.exit(3)
    if fault == "hang":
        time.sleep(60)
    if fault == "words":
        writer.write(b"Found 132 planes.\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
