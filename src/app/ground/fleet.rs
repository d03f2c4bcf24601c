//! Received records for other stations, vehicles and programs over Zenoh, and answers to history queries.
//!
//! A topic of a payload's flight is the key expression `windhover/PAYLOAD/TOPIC`, for example
//! `windhover/alpha/target/ugv/state`; values are the flight's protobuf messages, their encoding is
//! `application/protobuf;SCHEMA`, their timestamp is their time of validity. Records that arrive live are published;
//! all records answer queries: with `_time=[..]` all records of that span, without it the latest of each key.

use std::collections::{BTreeMap, HashSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use tokio::sync::{Semaphore, mpsc};
use zenoh::key_expr::KeyExpr;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{Query, TimeRange, ZenohParameters as _};
use zenoh::time::{NTP64, Timestamp, TimestampId};
use zenoh::{Session, Wait as _};

use super::history;
use super::ros_graph::RosGraph;
use crate::io::clock::HostClock;
use crate::io::link::Arrival;
use crate::io::proto::link::Thumbnail;
use windhover_base::time::MonoTime;

/// Where a station listens by default.
pub const LOOPBACK: &str = "tcp/127.0.0.1:7447";
/// Records on their way to Zenoh; beyond this number records are left out, as on every live channel.
const QUEUE: usize = 1_024;
/// Records of each key that are kept in memory until they are certainly on the disk: far more than arrive between two
/// syncs.
const RECENT: usize = 256;
/// Keys kept in memory.
const KEYS: usize = 4_096;
/// Queries answered at the same time; others wait.
const ANSWERS: usize = 2;

/// One record as Zenoh receives it.
#[derive(Clone)]
struct Sample {
    key: KeyExpr<'static>,
    schema_name: Arc<str>,
    payload: Arc<str>,
    run: u32,
    number: u32,
    t: MonoTime,
    data: Arc<[u8]>,
}

/// The latest samples of each key, in order of arrival.
type Recent = Arc<Mutex<BTreeMap<String, VecDeque<Sample>>>>;

/// The connection to Zenoh.
pub struct Fleet {
    recent: Recent,
    publish: mpsc::Sender<Sample>,
    ros: Option<RosGraph>,
}

/// The key expression of a payload's topic; `None` where the names contain reserved characters.
fn key(payload: &str, topic: &str) -> Option<KeyExpr<'static>> {
    let key = KeyExpr::try_from(format!("windhover/{payload}{topic}")).ok()?;
    (!key.is_wild()).then_some(key)
}

fn encoding(schema_name: &str) -> String {
    format!("application/protobuf;{schema_name}")
}

fn system_time(t: MonoTime) -> SystemTime {
    UNIX_EPOCH + Duration::from_nanos(u64::try_from(t.ns()).unwrap_or(0))
}

fn stamp(t: MonoTime, id: TimestampId) -> Timestamp {
    let since = Duration::from_nanos(u64::try_from(t.ns()).unwrap_or(0));
    Timestamp::new(NTP64::from(since), id)
}

/// A configuration of Zenoh: a file in its own format, an endpoint to connect to, or one on loopback where the station
/// listens as a router. There is no multicast discovery, and nothing listens beyond loopback, unless a file configures it.
fn configuration(words: &str, listens: bool) -> zenoh::Result<zenoh::Config> {
    let is_endpoint = ["tcp/", "udp/"].iter().any(|scheme| words.starts_with(scheme));
    if !is_endpoint {
        return zenoh::Config::from_file(words);
    }
    let mut config = zenoh::Config::default();
    let at = serde_json::json!([words]).to_string();
    config.insert_json5("scouting/multicast/enabled", "false")?;
    if listens {
        config.insert_json5("mode", r#""router""#)?;
        config.insert_json5("listen/endpoints", &at)?;
    } else {
        config.insert_json5("mode", r#""client""#)?;
        config.insert_json5("connect/endpoints", &at)?;
    }
    Ok(config)
}

/// Joins Zenoh (see `configuration`). Where a router has the place on loopback already, the station connects to it.
async fn join(words: &str) -> zenoh::Result<Session> {
    if words != LOOPBACK {
        return zenoh::open(configuration(words, false)?).await;
    }
    match zenoh::open(configuration(words, true)?).await {
        Ok(session) => Ok(session),
        Err(taken) => zenoh::open(configuration(words, false)?).await.map_err(|_| taken),
    }
}

impl Fleet {
    /// Joins Zenoh (see `configuration`) and answers queries from the files under `root`, until the program ends. With
    /// a domain the payloads are in its graph of ROS, too.
    pub async fn open(words: &str, root: PathBuf, ros: Option<u8>) -> zenoh::Result<Self> {
        let session = join(words).await?;
        let ros = ros.map(|domain| RosGraph::join(session.clone(), domain, HostClock::start()));
        let id = TimestampId::from(session.zid());
        let queries = session.declare_queryable("windhover/**").await?;
        let recent = Recent::default();
        let held = Arc::clone(&recent);
        tokio::spawn(async move {
            let (root, turns) = (Arc::<Path>::from(root), Arc::new(Semaphore::new(ANSWERS)));
            while let Ok(query) = queries.recv_async().await {
                let Ok(turn) = Arc::clone(&turns).acquire_owned().await else { return };
                let (held, root) = (Arc::clone(&held), Arc::clone(&root));
                tokio::task::spawn_blocking(move || {
                    // The client may be gone.
                    let _ = Answer { query: &query, id }.give(&held, &root);
                    drop(turn);
                });
            }
        });
        let (publish, mut queue) = mpsc::channel::<Sample>(QUEUE);
        tokio::spawn(async move {
            while let Some(sample) = queue.recv().await {
                let put = session
                    .put(&sample.key, &sample.data[..])
                    .encoding(encoding(&sample.schema_name))
                    .timestamp(stamp(sample.t, id))
                    .congestion_control(CongestionControl::Drop)
                    .priority(Priority::RealTime);
                // There may be no receiver.
                let _ = put.await;
            }
        });
        Ok(Self { recent, publish, ros })
    }

    /// Takes a record that arrived.
    pub fn record(&self, arrival: &Arrival) {
        if let Some(ros) = &self.ros {
            ros.record(arrival);
        }
        let Some(key) = key(&arrival.payload, &arrival.channel.topic) else { return };
        let sample = Sample {
            key,
            schema_name: arrival.channel.schema_name.as_str().into(),
            payload: Arc::clone(&arrival.payload),
            run: arrival.run,
            number: arrival.number,
            t: arrival.publish_time,
            data: arrival.data.as_slice().into(),
        };
        {
            let mut recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
            let name = sample.key.as_str();
            if recent.len() < KEYS || recent.contains_key(name) {
                let held = recent.entry(name.to_owned()).or_default();
                held.push_back(sample.clone());
                if held.len() > RECENT {
                    held.pop_front();
                }
            }
        }
        if arrival.live {
            // The queue is full: Zenoh's engine is behind, and the next estimate is of more use than this one.
            let _ = self.publish.try_send(sample);
        }
    }

    /// Takes a picture of a payload's camera; only ROS has a topic for it.
    pub fn thumbnail(&self, payload: &Arc<str>, thumbnail: &Thumbnail) {
        if let Some(ros) = &self.ros {
            ros.thumbnail(payload, thumbnail);
        }
    }
}

/// The answer to one query.
struct Answer<'a> {
    query: &'a Query,
    id: TimestampId,
}

impl Answer<'_> {
    fn give(&self, recent: &Recent, root: &Path) -> zenoh::Result<()> {
        let held: Vec<Sample> = {
            let recent = recent.lock().unwrap_or_else(PoisonError::into_inner);
            let asked = recent.values().flatten().filter(|s| self.query.key_expr().intersects(&s.key));
            asked.cloned().collect()
        };
        match self.query.parameters().time_range() {
            None => self.latest(&held),
            Some(Ok(range)) => self.span(&range.resolve(), &held, root),
            Some(Err(error)) => self.query.reply_err(format!("_time: {error}")).wait(),
        }
    }

    fn latest(&self, held: &[Sample]) -> zenoh::Result<()> {
        let mut latest: BTreeMap<&str, &Sample> = BTreeMap::new();
        for sample in held {
            let best = latest.entry(sample.key.as_str()).or_insert(sample);
            if sample.t > best.t {
                *best = sample;
            }
        }
        latest.into_values().try_for_each(|s| self.reply(&s.key, &s.schema_name, s.t, &s.data))
    }

    /// All records of a span: from the files, then those that are only in memory.
    fn span(&self, span: &TimeRange<SystemTime>, held: &[Sample], root: &Path) -> zenoh::Result<()> {
        let mut given: HashSet<(Arc<str>, u32, u32)> = HashSet::new();
        let in_memory: HashSet<(&str, u32, u32)> =
            held.iter().map(|s| (&*s.payload, s.run, s.number)).collect();
        let mut keys: BTreeMap<String, Option<KeyExpr<'static>>> = BTreeMap::new();
        let mut outcome = Ok(());
        history::read(
            root,
            |_| true,
            |past| {
                let name = format!("windhover/{}{}", past.payload, past.topic);
                let asked = keys.entry(name).or_insert_with(|| {
                    key(past.payload, past.topic).filter(|key| self.query.key_expr().intersects(key))
                });
                let Some(asked) = asked else { return true };
                if span.contains(system_time(past.t)) {
                    if in_memory.contains(&(past.payload, past.run, past.number)) {
                        given.insert((past.payload.into(), past.run, past.number));
                    }
                    outcome = self.reply(asked, past.schema_name, past.t, past.data);
                }
                outcome.is_ok()
            },
        );
        outcome?;
        held.iter()
            .filter(|s| span.contains(system_time(s.t)))
            .filter(|s| !given.contains(&(Arc::clone(&s.payload), s.run, s.number)))
            .try_for_each(|s| self.reply(&s.key, &s.schema_name, s.t, &s.data))
    }

    fn reply(&self, key: &KeyExpr<'static>, schema: &str, t: MonoTime, data: &[u8]) -> zenoh::Result<()> {
        let reply = self.query.reply(key, data).encoding(encoding(schema)).timestamp(stamp(t, self.id));
        reply.wait()
    }
}
