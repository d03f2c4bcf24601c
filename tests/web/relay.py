"""A UDP relay that can be cut, as a radio is when the helicopter turns its antenna away."""

import select
import socket
import threading


class Relay:
    def __init__(self, target):
        self.target, self.cut = target, False
        self.inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.inside.bind(("127.0.0.1", 0))
        self.port = self.inside.getsockname()[1]
        self.outside, self.stopped = {}, threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self):
        callers = {}
        while not self.stopped.is_set():
            for ready in select.select([self.inside, *callers], [], [], 0.2)[0]:
                try:
                    data, sender = ready.recvfrom(65_536)
                except ConnectionRefusedError:
                    continue
                if self.cut:
                    continue
                if ready is not self.inside:
                    self.inside.sendto(data, callers[ready])
                    continue
                if sender not in self.outside:
                    out = self.outside[sender] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                    out.connect(("127.0.0.1", self.target))
                    callers[out] = sender
                self.outside[sender].send(data)

    def stop(self):
        self.stopped.set()
        self.thread.join()
        for end in (self.inside, *self.outside.values()):
            end.close()
