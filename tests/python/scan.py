"""Scans every port of a host from here: `python3 scan.py HOST` prints {"tcp": [..], "udp": [..]}.

TCP ports that accept; UDP ports that do not answer "port unreachable". Meant for a network namespace whose
kernel was told to answer without limit.
"""

import errno
import json
import select
import socket
import sys

BATCH = 400


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


def udp(host, ports, tries=3):
    """Open are those that stay silent each time: an answer that is lost makes a port look open."""
    for _ in range(tries):
        probes = []
        for port in ports:
            probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            probe.setblocking(False)
            probe.connect((host, port))
            probe.send(b"hello")
            probes.append((port, probe))
        select.select([], [], [], 0.05)
        silent = []
        for port, probe in probes:
            try:
                probe.recv(2_048)
            except OSError as error:
                if error.errno != errno.ECONNREFUSED:
                    silent.append(port)
            probe.close()
        ports = silent
    return ports


def main():
    host, found = sys.argv[1], {"tcp": [], "udp": []}
    for start in range(1, 65_536, BATCH):
        ports = range(start, min(65_536, start + BATCH))
        found["tcp"] += tcp(host, ports)
        found["udp"] += udp(host, list(ports))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
