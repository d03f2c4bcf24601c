"""What the bench asserts, one function a scenario. Each is given the machine in flight, its daemon ready,
raises `Failure` with what was seen instead, and returns figures for the results."""

import random
import re
import time

from compare import against_replay, against_stream, against_truth, demand, listed
from flight import ESTIMATE_S, EVENT_S, same_daemon, sessions
from machine import Failure

# Of the vehicle as seen from the helicopter, and with the receiver's own error (a few metres here).
POSITION_M = 4.0
ABSOLUTE_M = 15.0
HEADING_DEG = 12.0
# A service that ends at once takes longer to stop than this on an emulator that is short of time, seconds.
SLOW_STOP_S = 1.0
# Longest that may be missing from the card after a power cut, seconds: the contract's one second, and the
# time an emulated machine takes to write it.
LOST_S = 3.0


def cold_boot(flight):
    """From power on to ready and to an estimate; then the daemon is stopped and started again in flight."""
    machine = flight.machine
    ready = machine.since_boot()
    flight.tracking(after=0)
    estimate = machine.since_boot()
    # The sandbox holds on a real boot: no root, nothing writable but the card, devices open.
    user = machine.run(f"stat -c %U /proc/{machine.service('MainPID')}")
    demand(user == "windhover", f"the daemon runs as {user}")
    demand(machine.run("findmnt -no OPTIONS / | tr , '\\n' | grep -x ro") == "ro", "the root is writable")
    ports = sorted(line.split()[4] for line in machine.run("ss -Hlnutp | grep windhover; true").splitlines())
    demand(ports == ["0.0.0.0:7447"], f"open ports are {ports}; configured is the link's alone")
    pulse, _ = flight.line(["device_up", "about=pps"], 0)
    time.sleep(45)
    memory = machine.service("MemoryCurrent")
    session, row = flight.newest_flight()
    flight.kept["whole"] = session
    nothing, (stopped, result) = flight.stop_nothing(), flight.stop_daemon()
    # Where the emulator is too slow to end a `sleep` in a second, a card may be too slow for the end of a flight:
    # the daemon then reports that, and the next start completes it.
    demand(result == "success" or nothing > SLOW_STOP_S, f"stopping ended with {result} after {stopped} s")
    # A scenario that fills the card must not cost this one.
    machine.run(f"windhover store keep {row['flight']}")
    # What it knew goes on: a stop of seconds is no new flight for the filter.
    after = flight.start_daemon()
    warm, _ = flight.line(["warm_start"], after)
    demand("continues from" in warm, f"the restart was cold: {warm}")
    flight.wait_ready()
    return {"ready_s": round(ready, 1), "first_estimate_s": round(estimate, 1), "stop_s": stopped, "stop_nothing_s": nothing,
            "memory_mb": round(int(memory) / 1e6, 1), "pulse": pulse, "warm": warm,
            "kernel": machine.run("uname -r"), "boot": machine.run("systemd-analyze time | head -n 1", check=False)}


def landing(flight):
    """A flight off the card, that of the cold boot where it was on this machine: beside the truth, replayed, and as
    the ground received it."""
    args = flight.args
    if "whole" not in flight.kept:
        flight.tracking()
        time.sleep(45)
        flight.kept["whole"] = flight.newest_flight()[0]
    # What the ground missed while the daemon was down is sent again in the meantime.
    time.sleep(20)
    store = flight.land()
    flights = flight.flights(store)
    whole, work = flights[flight.kept["whole"]], flight.machine.work
    truth = against_truth(args, whole, work)
    demand(truth["compared"] >= 20, f"too few estimates to compare: {truth}")
    demand(truth["position_m"] < POSITION_M and truth["absolute_m"] < ABSOLUTE_M, f"position is off: {truth}")
    demand(truth["heading_deg"] < HEADING_DEG, f"heading is off: {truth}")
    replay = against_replay(args, whole, work)
    demand(replay["rows_equal"] >= 20, f"too few rows to compare with the replay: {replay}")
    stream = against_stream(args, whole, flight.station.out)
    demand(stream["received"] > 100 and stream["only_flown"] == stream["only_received"] == stream["received_twice"] == 0,
           f"card and ground differ: {stream}")
    return {"flights": len(flights), "truth": truth, "replay": replay, "stream": stream}


def unplug(flight):
    """Each device goes away and comes back; each change is reported, none ends the daemon."""
    machine = flight.machine
    with same_daemon(machine) as pid:
        for part in ("gps", "compass"):
            after = flight.lines()
            slot = machine.unplug_serial(part)
            flight.line(["device_down", f"about={part}"], after)
            time.sleep(3)
            machine.plug_serial(slot)
            flight.line(["device_up", f"about={part}"], after)
        # The camera: vivid's own control makes it vanish for a while.
        after = flight.lines()
        machine.run("v4l2-ctl -d /dev/video0 -c disconnect=1", check=False)
        flight.line(["device_down", "about=camera"], after)
        flight.line(["device_up", "about=camera"], after)
        flight.healthy_camera("after it was disconnected")
        flight.tracking()
    return {"pid": int(pid)}


# Faults of vivid: its controls, words of the log they must lead to, controls that end them.
FAULTS = [
    ("percentage_of_dropped_buffers=60", ["camera_frames_missed"], "percentage_of_dropped_buffers=0"),
    ("inject_v4l2_buf_flag_error=1", ["camera_frame_damaged"], None),
    # vivid takes these two up when a stream begins.
    ("wrap_timestamp=2,inject_fatal_streaming_error=1", ["camera_stamps_unusable"], "wrap_timestamp=0"),
    ("wrap_sequence_number=1,inject_fatal_streaming_error=1", None, "wrap_sequence_number=0"),
    # One buffer is refused: whether the stream goes on or begins anew is the driver's matter.
    ("inject_vidioc_qbuf_error=1", None, None),
    # The stream ends, and the first attempts to restart it fail too. Its loss is reported twice a minute at most,
    # its return always.
    ("inject_vidioc_reqbufs_error=1,inject_fatal_streaming_error=1", ["device_up", "about=camera"], None),
    ("inject_vidioc_streamon_error=1,inject_fatal_streaming_error=1", ["device_up", "about=camera"], None),
]


def provoked(flight, controls, words, after):
    """Sets controls of the camera until the daemon says these words; its line. vivid gives a damaged buffer to
    whichever of its two ends has one first, the camera or what is shown to it: once may not be enough."""
    limit = time.monotonic() + EVENT_S
    while True:
        flight.machine.run(f"v4l2-ctl -d /dev/video0 -c {controls}")
        try:
            return flight.line(words, after, 20)[0] if words else None
        except Failure:
            if time.monotonic() > limit:
                raise


def camera_faults(flight):
    """Errors, lost and wrongly stamped buffers by the driver's own fault injection; frames come again after
    each."""
    machine, seen = flight.machine, {}
    with same_daemon(machine):
        for controls, words, back in FAULTS:
            after, name = flight.lines(), controls.split("=")[0]
            line = provoked(flight, controls, words, after)
            time.sleep(4)
            if back:
                machine.run(f"v4l2-ctl -d /dev/video0 -c {back}")
            seen[name] = [flight.healthy_camera(f"after {controls}"), line]
    return seen


def busy(flight):
    """Other programs hold a serial port and the camera when the daemon starts; then they let go."""
    machine = flight.machine
    flight.stop_daemon()
    hold = "setsid {} >/dev/null 2>&1 </dev/null & echo $!"
    # 0x540c is TIOCEXCL: nobody but root may open the port as well.
    port = machine.run(hold.format("perl -e 'open F, \"+<\", \"/dev/ttyS1\"; ioctl(F, 0x540c, 0); sleep 3600'"))
    camera = machine.run(hold.format("v4l2-ctl -d /dev/video0 --stream-mmap"))
    time.sleep(3)
    after = flight.start_daemon()
    seen = [flight.line(["device_down", f"about={part}", "fault=busy"], after)[0] for part in ("gps", "camera")]
    flight.line(["not_ready"], after)
    with same_daemon(machine):
        machine.run(f"kill {port} {camera}")
        for part in ("gps", "camera"):
            flight.line(["device_up", f"about={part}"], after)
        flight.wait_ready()
    return {"seen": seen}


def pixel_formats(flight):
    """The camera gives other formats than grey: each is understood, or what it offers is used instead."""
    machine, seen = flight.machine, {}
    for fourcc, asked in (("YUYV", "YUYV"), ("UYVY", "UYVY"), ("NV12", "NV12"), ("RGB3", "RGB24"), ("GREY", "MJPG")):
        flight.stop_daemon()
        flight.stop_feeding()
        machine.run(f"systemctl stop bench-camera; echo {fourcc} >/run/bench-format", 60)
        flight.configure(f"s/^pixel_format = .*/pixel_format = \"{asked}\"/")
        flight.pixel_format = fourcc
        flight.keep_feeding()
        machine.run("systemctl start bench-camera", 60)
        after = flight.start_daemon()
        up, _ = flight.line(["device_up", "about=camera"], after)
        demand(fourcc in up, f"{asked} was asked for: {up}")
        if fourcc == "GREY":
            flight.line(["camera_format_differs", "MJPG"], after)
        # What the filter knew goes on without a camera: it is the frames that must be seen.
        line, _ = flight.line(["health ", "ugv=tracking"], after + 3)
        while int(re.search(r"ugv_seen=(\d+)", line).group(1)) < 3:
            line, after = flight.tracking()
        seen[asked] = [up, line]
    machine.run("rm /run/bench-format")
    flight.configure_back()
    return seen


def hang(flight):
    """A daemon that hangs: the watchdog has the daemon started again, it goes on with what it knew."""
    machine = flight.machine
    pid = machine.service("MainPID")
    after = flight.lines()
    # SIGSTOP stops every thread of the process, not one task alone: the watchdog is no longer stroked.
    machine.run(f"kill -STOP {pid}")
    began = time.monotonic()
    while machine.service("MainPID") in (pid, "0"):
        demand(time.monotonic() - began < EVENT_S, "the watchdog did not end the hung daemon")
        time.sleep(1)
    took = time.monotonic() - began
    warm, _ = flight.line(["warm_start"], after)
    demand("continues from" in warm, f"the restart was cold: {warm}")
    flight.wait_ready()
    return {"restarted_after_s": round(took, 1), "warm": warm}


def card_absent(flight):
    """No card: the daemon flies, says what it waits for, writes nothing to the system's own disk; the card
    that comes is used."""
    machine = flight.machine
    flight.stop_daemon()
    machine.run("systemctl stop var-lib-windhover.mount", 60)
    after = flight.start_daemon()
    flight.line(["recording_stopped"], after)
    flight.line(["not_ready", "store"], after)
    flight.tracking()
    inside = machine.run("find /var/lib/windhover -type f")
    demand(not inside, f"files on the system's disk: {inside}")
    with same_daemon(machine):
        machine.run("systemctl start var-lib-windhover.mount", 60)
        flight.line(["health ", "card=ok"], after)
        flight.wait_ready()
    return {}


def card_full(flight):
    """The card fills up: that is reported, estimates go on; room on it, and recording goes on."""
    machine = flight.machine
    with same_daemon(machine):
        # What an operator marks is not deleted to make room.
        machine.run("ls /var/lib/windhover/FLIGHTS | xargs -n 1 windhover store keep; true", 120)
        after = flight.lines()
        machine.run("fallocate -l $(($(df --output=avail -B1 /var/lib/windhover | tail -n 1) - 4000000)) /var/lib/windhover/filler")
        stopped, _ = flight.line(["recording_stopped"], after, 600)
        rate = flight.healthy_camera("with a full card")
        flight.tracking()
        after = flight.lines()
        machine.run("rm /var/lib/windhover/filler")
        resumed, _ = flight.line(["recording_resumed"], after)
    return {"camera_hz": rate, "stopped": stopped, "resumed": resumed}


def card_errors(flight):
    """The card answers with I/O errors (dm-flakey), the daemon flies on; a new start finds the card again."""
    machine = flight.machine
    flight.stop_daemon()
    machine.run("systemctl stop var-lib-windhover.mount && modprobe dm-flakey", 120)
    sectors = machine.run("blockdev --getsz /dev/sda")
    machine.run(f"echo 0 {sectors} linear /dev/sda 0 | dmsetup create card")
    machine.run("mount -o noatime,errors=remount-ro /dev/mapper/card /var/lib/windhover", 120)
    flight.start_daemon()
    flight.wait_ready()
    with same_daemon(machine):
        after = flight.lines()
        # Up for no second, down for thirty, again and again: every request fails.
        machine.run(f"echo 0 {sectors} flakey /dev/sda 0 0 30 | dmsetup reload card "
                    "&& dmsetup suspend --nolockfs --noflush card && dmsetup resume card")
        stopped, _ = flight.line(["recording_stopped"], after)
        rate = flight.healthy_camera("with a failing card")
        flight.tracking()
    flight.stop_daemon()
    machine.run("umount -l /var/lib/windhover; dmsetup remove --retry card; e2fsck -fy /dev/sda >/dev/null; "
                "systemctl start var-lib-windhover.mount", 120)
    flight.start_daemon()
    flight.wait_ready()
    return {"camera_hz": rate, "stopped": stopped}


def acknowledged(flight):
    """Estimates by session that are durable by now: the flight has been written to and synced since they
    were seen. One thread writes, syncs, and only then writes again."""
    def listed():
        return sessions(flight.machine.run("windhover store list --json", 120))
    seen = listed()
    newest, limit, grown, last = max(seen), time.monotonic() + EVENT_S, 0, None
    while grown < 2:
        size = listed()[newest]["bytes"]
        grown += last is not None and size > last
        last = size
        demand(time.monotonic() < limit, "the flight does not grow")
        time.sleep(0.5)
    return {session: row["estimates"] for session, row in seen.items()}


def power_cut(flight, cuts=2):
    """Power goes at random moments; every boot afterwards seals what was cut and flies again. What the
    daemon had said is on the card is still there; of what the ground had, only the last moment is not."""
    durable, cold = {}, []
    for cut in range(cuts):
        if cut:
            flight.take_off()
            cold.append(flight.line(["warm_start"], 0)[0])
        flight.tracking(seconds=ESTIMATE_S)
        durable |= acknowledged(flight)
        time.sleep(random.uniform(0, 3))
        flight.cut_power()
    flight.take_off()
    cold.append(flight.line(["warm_start"], 0)[0])
    demand(not any("continues from" in line for line in cold), f"a state of another boot was used: {cold}")
    last = flight.newest_flight()[0]
    time.sleep(30)
    store = flight.land()
    flights = flight.flights(store)
    demand(len(flights) > cuts, f"{len(flights)} flights after {cuts} cuts")
    streams = {}
    for session, folder in flights.items():
        streams[session] = stream = against_stream(flight.args, folder, flight.station.out)
        demand(stream["received"] > 0, f"the ground has nothing of session {session}")
        # The last flight's end comes with the next one.
        demand(session == last or stream["only_flown"] == 0, f"session {session} did not reach the ground: {stream}")
        since = stream["only_received_since_ns"]
        stream["lost_s"] = round((stream["last_received_ns"] - since) / 1e9, 2) if since else 0.0
        demand(stream["lost_s"] <= LOST_S, f"session {session} lost more than its last moment: {stream}")
    found = {session: row["estimates"] for session, row in listed(flight.args, store).items()}
    lost = {session: (count, found.get(session)) for session, count in durable.items() if found.get(session, 0) < count}
    demand(not lost, f"estimates that were on the card (asked, found): {lost}")
    return {"durable": durable, "found": found, "streams": streams, "restart": cold}


def power_cut_long(flight):
    """The same ten times."""
    return power_cut(flight, 10)


# After these the machine is off.
LANDED = (landing, power_cut, power_cut_long)
# One boot serves all of a row, as long as they go well; each row begins with a new card.
SHORT = [[cold_boot, unplug, camera_faults, hang, landing], [power_cut]]
LONG = [[cold_boot, unplug, camera_faults, busy, pixel_formats, card_absent, card_full, card_errors, hang, landing],
        [power_cut_long]]
