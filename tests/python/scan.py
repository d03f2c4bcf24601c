"""Scans every port of a host from here: `python3 scan.py HOST` prints {"tcp": [..], "udp": [..]}.

TCP ports that accept; UDP ports that never answer "port unreachable".
"""

import errno
import json
import select
import socket
import sys
import time

# Ports asked at once and the seconds between: the later rounds are for answers that a kernel held back.
ROUNDS = ((400, 0.05), (100, 0.12), (100, 0.12), (50, 0.2))


def tcp(host, ports):
    waiting, poll, found = {}, select.poll(), []
    for port in ports:
        probe = socket.socket()
        probe.setblocking(False)
        if probe.connect_ex((host, port)) == 0:
            found.append(port)
            probe.close()
            continue
        waiting[probe.fileno()] = (port, probe)
        poll.register(probe, select.POLLOUT)
    while waiting:
        ready = poll.poll(2_000)
        if not ready:
            break
        for fd, _ in ready:
            port, probe = waiting.pop(fd)
            poll.unregister(fd)
            if probe.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0:
                found.append(port)
            probe.close()
    for _, probe in waiting.values():
        probe.close()
    return found


def udp(host, ports, pause):
    probes, silent = [], []
    for port in ports:
        probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        probe.setblocking(False)
        probe.connect((host, port))
        probe.send(b"hello")
        probes.append((port, probe))
    time.sleep(pause)
    for port, probe in probes:
        try:
            probe.recv(2_048)
        except OSError as error:
            if error.errno != errno.ECONNREFUSED:
                silent.append(port)
        probe.close()
    return silent


def batches(ports, size):
    return (ports[start : start + size] for start in range(0, len(ports), size))


def main():
    host, every = sys.argv[1], range(1, 65_536)
    accept = [port for batch in batches(every, ROUNDS[0][0]) for port in tcp(host, batch)]
    silent = every
    for size, pause in ROUNDS:
        silent = [port for batch in batches(silent, size) for port in udp(host, batch, pause)]
    print(json.dumps({"tcp": accept, "udp": silent}))


if __name__ == "__main__":
    main()
