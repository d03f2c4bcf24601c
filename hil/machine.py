"""The virtual payload computer: an emulated PC with Debian's kernel, UARTs, a camera and a data card; and
what is around it: the feed of its lines, the ground station at the other end of its link."""

import os
import re
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path


# Where the serial lines sit on the PCI bus.
SERIAL_SLOTS = {"gps": "0x10", "compass": "0x11"}
# Lines of the host's own.
CHANNELS = ("frames", "pulse", "control")
LINK_PORT = 17447


class Failure(Exception):
    """An assertion of a scenario that does not hold; says what was seen instead. `output`: lines of the tool
    that failed."""

    def __init__(self, words, output=()):
        super().__init__(words)
        self.output = output


class Machine:
    """One boot after another of the same computer with the same data card.

    `directory` holds vmlinuz, initrd and root.img of build.sh; `work` gets the card, sockets and logs.
    """

    def __init__(self, directory, work, card_mb=2000):
        self.directory, self.work = Path(directory), Path(work)
        self.work.mkdir(parents=True, exist_ok=True)
        self.card = self.work / "card.img"
        self.console = self.work / "console.log"
        self.boots = 0
        self.process = None
        self.new_card(card_mb)

    def new_card(self, megabytes):
        """An empty data card."""
        self.card.unlink(missing_ok=True)
        with open(self.card, "wb") as file:
            file.truncate(megabytes << 20)
        subprocess.run(["mkfs.ext4", "-q", "-F", "-L", "WINDHOVER", str(self.card)], check=True)

    def socket_path(self, name):
        """Path of one of the machine's sockets: gps, compass, frames, pulse, control."""
        return str(self.work / name)

    def boot(self, cpus=2):
        """Starts the machine; returns at once."""
        for name in (*SERIAL_SLOTS, *CHANNELS):
            Path(self.socket_path(name)).unlink(missing_ok=True)
        self.boots += 1
        self.booted_at = time.monotonic()
        self.log = self.work / f"daemon-{self.boots}.log"
        self.log.unlink(missing_ok=True)
        channels = []
        for name, slot in SERIAL_SLOTS.items():
            channels += ["-chardev", f"socket,id={name},path={self.socket_path(name)},server=on,wait=off"]
            # PCI, so that the driver can let go of one and take it back; they become /dev/ttyS1 and /dev/ttyS2.
            channels += ["-device", f"pci-serial,chardev={name},addr={slot}"]
        for name in CHANNELS:
            channels += ["-chardev", f"socket,id={name},path={self.socket_path(name)},server=on,wait=off"]
            channels += ["-device", f"virtserialport,chardev={name},name=bench.{name}"]
        with open(self.console, "ab") as console:
            console.write(f"\n===== boot {self.boots} =====\n".encode())
        command = [
            "qemu-system-x86_64", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", str(cpus), "-m", "1024",
            "-nographic", "-nodefaults", "-no-reboot",
            "-kernel", str(self.directory / "vmlinuz"), "-initrd", str(self.directory / "initrd"),
            "-append", "root=/dev/vda ro console=ttyS0 systemd.volatile=state net.ifnames=0 mitigations=off quiet "
                       "random.trust_cpu=on",
            "-drive", f"file={self.directory / 'root.img'},if=virtio,format=raw,readonly=on",
            "-drive", f"file={self.card},if=ide,format=raw,cache=none",
            "-device", "virtio-serial-pci",
            "-chardev", f"file,id=console,path={self.console},append=on", "-serial", "chardev:console",
            *channels,
            "-chardev", f"file,id=log,path={self.log}", "-device", "virtserialport,chardev=log,name=bench.log",
            # The parallel port whose interrupt is the receiver's pulse.
            "-chardev", "null,id=parallel", "-device", "isa-parallel,chardev=parallel,iobase=0x378,irq=7",
            "-netdev", f"user,id=net,hostfwd=udp:127.0.0.1:{LINK_PORT}-10.0.2.15:7447",
            "-device", "virtio-net-pci,netdev=net",
        ]
        with open(self.work / "qemu.log", "ab") as log:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self.control = None

    def since_boot(self):
        """Seconds since power came on."""
        return time.monotonic() - self.booted_at

    def _connect(self, name, seconds):
        limit = time.monotonic() + seconds
        while True:
            try:
                channel = socket.socket(socket.AF_UNIX)
                channel.connect(self.socket_path(name))
                return channel
            except OSError:
                if time.monotonic() > limit or self.process.poll() is not None:
                    raise Failure(f"the emulator does not open {name}; see {self.work}/qemu.log")
                time.sleep(0.1)

    def wait_for_control(self, seconds=180):
        """Waits until the guest answers on its control line."""
        self.control = self._connect("control", 10)
        self.control.settimeout(seconds)
        self.answers = b""
        self._answer(r"bench-control: up", seconds)

    def _answer(self, pattern, seconds):
        limit = time.monotonic() + seconds
        expression = re.compile(pattern.encode())
        while True:
            found = expression.search(self.answers)
            if found:
                before, self.answers = self.answers[: found.start()], self.answers[found.end():]
                return before.decode(errors="replace"), found
            if time.monotonic() > limit:
                raise Failure(f"the guest does not answer ({pattern}); console: {self.console}")
            self.control.settimeout(max(0.1, limit - time.monotonic()))
            try:
                data = self.control.recv(65536)
            except TimeoutError:
                continue
            if not data:
                raise Failure("the guest went away")
            self.answers += data

    def run(self, command, seconds=60, check=True):
        """Runs a command in the guest; its output."""
        self.control.sendall(command.encode() + b"\n")
        text, found = self._answer(r"bench-control: exit (\d+)\r?\n", seconds)
        code = int(found.group(1))
        if check and code != 0:
            raise Failure(f"{command!r} in the guest: exit {code}: {text.strip()[-400:]}")
        return text.replace("\r", "").strip()

    def unplug_serial(self, name):
        """Takes a serial line away from its driver, as pulling the adapter does."""
        slot = f"0000:00:{int(SERIAL_SLOTS[name], 16):02x}.0"
        self.run(f"echo {slot} > /sys/bus/pci/drivers/serial/unbind")
        return slot

    def plug_serial(self, slot):
        """Gives it back."""
        self.run(f"echo {slot} > /sys/bus/pci/drivers/serial/bind")

    def journal(self):
        """The daemon's log of this boot, line by line; the guest writes it to a file here."""
        return self.log.read_text(errors="replace").splitlines() if self.log.exists() else []

    def wait_journal(self, words, seconds, after=0):
        """Waits for a line of the daemon's log that holds all of `words`, after line number `after`; the line
        and the number of the next."""
        limit = time.monotonic() + seconds
        while True:
            lines = self.journal()
            for number, line in enumerate(lines):
                if number >= after and all(word in line for word in words):
                    return line, number + 1
            if time.monotonic() > limit:
                tail = "\n".join(lines[-15:])
                raise Failure(f"no line with {words} in {seconds} s; the last lines:\n{tail}")
            time.sleep(0.5)

    def service(self, what):
        """A property of the daemon's unit, as systemctl shows it."""
        return self.run(f"systemctl show windhover -p {what} --value")

    def power_cut(self):
        """Power goes, this instant."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def shut_down(self, seconds=60):
        """Shuts down as a user would."""
        try:
            self.control.sendall(b"systemctl poweroff\n")
            self.process.wait(seconds)
        except (subprocess.TimeoutExpired, OSError):
            self.power_cut()
            raise Failure("the machine does not shut down")

    def stop(self):
        """Ends the machine, however it is."""
        if self.process and self.process.poll() is None:
            self.power_cut()

    def card_files(self):
        """Copies the card's files (the machine is off); their folder."""
        out = self.work / "files"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        # The journal is replayed first, as the next mount would.
        subprocess.run(["e2fsck", "-p", str(self.card)], stdout=subprocess.DEVNULL, check=False)
        subprocess.run(["debugfs", "-R", f"rdump / {out}", str(self.card)],
                       stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
        return out


class Feed:
    """A simulated flight that runs into the machine's lines in real time."""

    def __init__(self, machine, feeder, capture, pixel_format="GREY"):
        self.log = open(machine.work / "feed.log", "ab")
        sockets = [machine.socket_path(name) for name in ("gps", "compass", "frames", "pulse")]
        self.process = subprocess.Popen([feeder, capture, *sockets, pixel_format], stdout=self.log, stderr=self.log)

    def running(self):
        return self.process.poll() is None

    def stop(self):
        if self.running():
            self.process.terminate()
        self.process.wait()
        self.log.close()


class Station:
    """`windhover ground` at the other end of the machine's link: what it received stays in its folder."""

    def __init__(self, machine, windhover):
        keys, self.out = machine.directory / "keys", machine.work / "station"
        shutil.rmtree(self.out, ignore_errors=True)
        self.log = open(machine.work / "station.log", "wb")
        self.process = subprocess.Popen(
            [windhover, "ground", "--connect", f"127.0.0.1:{LINK_PORT}", "--authority", str(keys / "authority.pem"),
             "--certificate", str(keys / "station-bench.pem"), "--no-web", "--out", str(self.out)],
            stdin=subprocess.DEVNULL, stdout=self.log, stderr=self.log)

    def stop(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(20)
            except subprocess.TimeoutExpired:
                self.process.kill()
        self.process.wait()
        self.log.close()
