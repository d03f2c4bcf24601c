//! A UDP relay that behaves like a radio: loss, delay, a slow line with a queue, cuts, a new address.
//!
//! It has threads of its own and sleeps to a tenth of a millisecond, so that what is measured through it is
//! the link and not the runtime's timer.

use std::collections::HashMap;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, mpsc};
use std::time::{Duration, Instant};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// What the radio does to packets, each way.
#[derive(Clone, Copy, Debug)]
pub struct Radio {
    /// Probability that a packet is lost.
    pub loss: f64,
    /// Time on the way.
    pub delay: Duration,
    /// Bytes a second, IP and UDP headers included; `None` is as fast as the machine.
    pub rate: Option<f64>,
    /// Nothing passes.
    pub cut: bool,
}

impl Default for Radio {
    fn default() -> Self {
        Self { loss: 0.0, delay: Duration::from_millis(2), rate: None, cut: false }
    }
}

/// Seconds of data the slow line's queue holds.
const QUEUE_S: f64 = 2.0;
/// IPv4 and UDP headers, bytes.
const HEADERS: usize = 28;
/// How often threads look whether they are to end.
const LOOK: Duration = Duration::from_millis(200);

#[derive(Default)]
struct State {
    radio: Radio,
    generation: u64,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    down: AtomicU64,
    stopped: AtomicBool,
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("not poisoned")
    }
}

/// The relay; it stops when dropped.
pub struct Relay {
    pub address: SocketAddr,
    shared: Arc<Shared>,
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.stopped.store(true, Ordering::Relaxed);
    }
}

/// One direction: packets leave one after another at the line's speed, then take their time.
struct Lane {
    free_at: Instant,
    random: ChaCha8Rng,
    out: mpsc::Sender<(Instant, Vec<u8>)>,
}

impl Lane {
    fn new(seed: u64, socket: UdpSocket, to: Option<SocketAddr>) -> Self {
        let (out, queue) = mpsc::channel::<(Instant, Vec<u8>)>();
        std::thread::spawn(move || {
            for (at, packet) in queue {
                std::thread::sleep(at.saturating_duration_since(Instant::now()));
                let _ = match to {
                    Some(to) => socket.send_to(&packet, to),
                    None => socket.send(&packet),
                };
            }
        });
        Self { free_at: Instant::now(), random: ChaCha8Rng::seed_from_u64(seed), out }
    }

    fn pass(&mut self, radio: &Radio, packet: &[u8]) {
        let now = Instant::now();
        if radio.cut || self.random.random_bool(radio.loss) {
            return;
        }
        let start = self.free_at.max(now);
        if let Some(rate) = radio.rate {
            if (start - now).as_secs_f64() > QUEUE_S {
                return;
            }
            self.free_at = start + Duration::from_secs_f64((packet.len() + HEADERS) as f64 / rate);
        } else {
            self.free_at = now;
        }
        // The thread ends with this lane, not before.
        let _ = self.out.send((self.free_at + radio.delay, packet.to_vec()));
    }
}

impl Relay {
    /// Relays to `target`.
    pub fn start(target: SocketAddr, radio: Radio, seed: u64) -> Self {
        let socket = port();
        let address = socket.local_addr().expect("bound");
        let state = Mutex::new(State { radio, generation: 0 });
        let shared = Arc::new(Shared { state, ..Shared::default() });
        let of_thread = Arc::clone(&shared);
        std::thread::spawn(move || forward(&socket, target, &of_thread, seed));
        Self { address, shared }
    }

    /// Changes the weather.
    pub fn set(&self, change: impl FnOnce(&mut Radio)) {
        change(&mut self.shared.state().radio);
    }

    /// From now on the caller appears under another address, as after roaming.
    pub fn roam(&self) {
        self.shared.state().generation += 1;
    }

    /// Bytes that the target sent back, headers included.
    pub fn bytes_down(&self) -> u64 {
        self.shared.down.load(Ordering::Relaxed)
    }
}

fn port() -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a loopback port");
    socket.set_read_timeout(Some(LOOK)).expect("a time-out above zero");
    socket
}

/// What is known of one caller: under which address it appears, and the way up.
struct Caller {
    generation: u64,
    up: Lane,
    gone: Arc<AtomicBool>,
}

impl Drop for Caller {
    fn drop(&mut self) {
        self.gone.store(true, Ordering::Relaxed);
    }
}

fn forward(socket: &UdpSocket, target: SocketAddr, shared: &Arc<Shared>, seed: u64) {
    let mut callers: HashMap<SocketAddr, Caller> = HashMap::new();
    let mut buffer = vec![0; 65_536];
    while !shared.stopped.load(Ordering::Relaxed) {
        let Ok((length, from)) = socket.recv_from(&mut buffer) else { continue };
        let (radio, generation) = {
            let state = shared.state();
            (state.radio, state.generation)
        };
        if callers.get(&from).is_none_or(|caller| caller.generation != generation) {
            let outside = port();
            outside.connect(target).expect("loopback");
            let copy = |socket: &UdpSocket| socket.try_clone().expect("a file descriptor");
            let up = Lane::new(seed ^ 1, copy(&outside), None);
            let down = Lane::new(seed ^ 2, copy(socket), Some(from));
            let (of_thread, gone) = (Arc::clone(shared), Arc::new(AtomicBool::new(false)));
            let ended = Arc::clone(&gone);
            std::thread::spawn(move || back(&outside, down, &of_thread, &ended));
            callers.insert(from, Caller { generation, up, gone });
        }
        if let Some(caller) = callers.get_mut(&from) {
            caller.up.pass(&radio, &buffer[..length]);
        }
    }
}

/// What the target sends back to one caller.
fn back(outside: &UdpSocket, mut lane: Lane, shared: &Shared, gone: &AtomicBool) {
    let mut buffer = vec![0; 65_536];
    while !gone.load(Ordering::Relaxed) {
        // A target that is not there answers with an error; later it may be there again.
        let Ok(length) = outside.recv(&mut buffer) else { continue };
        shared.down.fetch_add((length + HEADERS) as u64, Ordering::Relaxed);
        let radio = shared.state().radio;
        lane.pass(&radio, &buffer[..length]);
    }
}
