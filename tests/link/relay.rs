//! A UDP relay that behaves like a radio: loss, delay, a slow line with a queue, cuts, a new address.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio::net::UdpSocket;
use tokio::sync::mpsc;
use tokio::time::Instant;

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

#[derive(Default)]
struct State {
    radio: Radio,
    generation: u64,
}

/// The relay; it stops when dropped.
pub struct Relay {
    pub address: SocketAddr,
    state: Arc<Mutex<State>>,
    down: Arc<AtomicU64>,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// One direction: packets leave one after another at the line's speed, then take their time.
struct Lane {
    free_at: Instant,
    random: ChaCha8Rng,
    out: mpsc::UnboundedSender<(Instant, Vec<u8>)>,
}

impl Lane {
    fn new(seed: u64, socket: Arc<UdpSocket>, to: Option<SocketAddr>) -> Self {
        let (out, mut queue) = mpsc::unbounded_channel::<(Instant, Vec<u8>)>();
        tokio::spawn(async move {
            while let Some((at, packet)) = queue.recv().await {
                tokio::time::sleep_until(at).await;
                let _ = match to {
                    Some(to) => socket.send_to(&packet, to).await,
                    None => socket.send(&packet).await,
                };
            }
        });
        Self { free_at: Instant::now(), random: ChaCha8Rng::seed_from_u64(seed), out }
    }

    fn pass(&mut self, radio: &Radio, packet: &[u8]) -> bool {
        let now = Instant::now();
        if radio.cut || self.random.random_bool(radio.loss) {
            return false;
        }
        let start = self.free_at.max(now);
        if let Some(rate) = radio.rate {
            if (start - now).as_secs_f64() > QUEUE_S {
                return false;
            }
            self.free_at = start + Duration::from_secs_f64((packet.len() + HEADERS) as f64 / rate);
        } else {
            self.free_at = now;
        }
        self.out.send((self.free_at + radio.delay, packet.to_vec())).is_ok()
    }
}

impl Relay {
    /// Relays to `target`.
    pub async fn start(target: SocketAddr, radio: Radio, seed: u64) -> Self {
        let socket = Arc::new(UdpSocket::bind("127.0.0.1:0").await.expect("a loopback port"));
        let address = socket.local_addr().expect("bound");
        let state = Arc::new(Mutex::new(State { radio, generation: 0 }));
        let down = Arc::new(AtomicU64::new(0));
        let task = tokio::spawn(forward(socket, target, Arc::clone(&state), Arc::clone(&down), seed));
        Self { address, state, down, task }
    }

    /// Changes the weather.
    pub fn set(&self, change: impl FnOnce(&mut Radio)) {
        change(&mut self.state.lock().expect("not poisoned").radio);
    }

    /// From now on the caller appears under another address, as after roaming.
    pub fn roam(&self) {
        self.state.lock().expect("not poisoned").generation += 1;
    }

    /// Bytes that the target sent back, headers included.
    pub fn bytes_down(&self) -> u64 {
        self.down.load(Ordering::Relaxed)
    }
}

async fn forward(
    socket: Arc<UdpSocket>,
    target: SocketAddr,
    state: Arc<Mutex<State>>,
    down: Arc<AtomicU64>,
    seed: u64,
) {
    let mut callers: HashMap<SocketAddr, (u64, Lane, tokio::task::JoinHandle<()>)> = HashMap::new();
    let mut buffer = vec![0; 65_536];
    loop {
        let Ok((length, from)) = socket.recv_from(&mut buffer).await else { continue };
        let (radio, generation) = {
            let state = state.lock().expect("not poisoned");
            (state.radio, state.generation)
        };
        if callers.get(&from).is_none_or(|(known, ..)| *known != generation) {
            let outside = Arc::new(UdpSocket::bind("127.0.0.1:0").await.expect("a loopback port"));
            outside.connect(target).await.expect("loopback");
            let up = Lane::new(seed ^ 1, Arc::clone(&outside), None);
            let mut lane = Lane::new(seed ^ 2, Arc::clone(&socket), Some(from));
            let (state, down) = (Arc::clone(&state), Arc::clone(&down));
            let back = tokio::spawn(async move {
                let mut buffer = vec![0; 65_536];
                loop {
                    // A target that is not there answers with an error; later it may be there again.
                    let Ok(length) = outside.recv(&mut buffer).await else { continue };
                    down.fetch_add((length + HEADERS) as u64, Ordering::Relaxed);
                    let radio = state.lock().expect("not poisoned").radio;
                    lane.pass(&radio, &buffer[..length]);
                }
            });
            if let Some((_, _, old)) = callers.insert(from, (generation, up, back)) {
                old.abort();
            }
        }
        if let Some((_, lane, _)) = callers.get_mut(&from) {
            lane.pass(&radio, &buffer[..length]);
        }
    }
}
