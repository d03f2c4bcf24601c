//! The payloads in a graph of ROS 2: what arrives live, in ROS's types and frames, on Zenoh as `rmw_zenoh_cpp` speaks.
//!
//! Each payload is a node `/PAYLOAD/windhover`. Its topics are those of a bag ([`crate::app::ros`]) behind its name;
//! `/tf`, `/tf_static`, `/diagnostics` and `/rosout` are ROS's own. A publisher is made with its first message.
//! `/tf_static` is kept for late subscribers, and given to those that ask for it as zenoh's advanced subscriber does.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::mpsc;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Reliability};
use zenoh::query::Queryable;
use zenoh::{Session, Wait as _};

use crate::app::ros::{RosNames, RosTranslator};
use crate::io::clock::HostClock;
use crate::io::link::Arrival;
use crate::io::proto::link::Thumbnail;
use crate::io::records::topic;
use crate::io::ros::RosRecord;
use crate::io::ros::rmw::{RosNode, attachment, gid, topic_key};
use windhover_base::time::MonoTime;

/// Records that wait to be converted; beyond this number they are left out, as on every live channel.
const QUEUE: usize = 1_024;
/// Messages that a subscriber keeps, as publishers announce it; of latched topics the last one.
const DEPTH: u32 = 10;
/// The name of each node.
const NODE: &str = "windhover";

/// What comes from payloads.
enum Input {
    Record { payload: Arc<str>, run: u32, topic: Box<str>, live: bool, log: MonoTime, data: Vec<u8> },
    Picture { payload: Arc<str>, t: MonoTime, jpeg: Vec<u8> },
}

/// The way into the graph.
pub struct RosGraph {
    inputs: mpsc::Sender<Input>,
}

impl RosGraph {
    /// Joins the graph of a domain over a session of Zenoh; a task publishes until the program ends.
    pub fn join(session: Session, domain: u8, clock: HostClock) -> Self {
        let (inputs, mut queue) = mpsc::channel(QUEUE);
        let mut nodes = Nodes {
            session,
            domain,
            clock,
            entities: 0,
            names: RosNames::with("payload_"),
            of: BTreeMap::new(),
        };
        tokio::spawn(async move {
            while let Some(input) = queue.recv().await {
                nodes.take(input);
            }
        });
        Self { inputs }
    }

    /// Takes a record that arrived. Back-filled ones are of use only where their content lasts.
    pub fn record(&self, arrival: &Arrival) {
        if !arrival.live && !lasts(&arrival.channel.topic) {
            return;
        }
        let input = Input::Record {
            payload: Arc::clone(&arrival.payload),
            run: arrival.run,
            topic: arrival.channel.topic.as_str().into(),
            live: arrival.live,
            log: arrival.log_time,
            data: arrival.data.clone(),
        };
        // The queue is full: the next message is of more use than this one.
        let _ = self.inputs.try_send(input);
    }

    /// Takes a picture.
    pub fn thumbnail(&self, payload: &Arc<str>, thumbnail: &Thumbnail) {
        let (t, jpeg) = (MonoTime::from_ns(thumbnail.time_ns), thumbnail.jpeg.clone());
        let _ = self.inputs.try_send(Input::Picture { payload: Arc::clone(payload), t, jpeg });
    }
}

/// Whether a topic's latest message counts for the whole run.
fn lasts(topic: &str) -> bool {
    matches!(topic, topic::DATUM | topic::TF | topic::CAMERA_CALIBRATION)
}

/// The payloads.
struct Nodes {
    session: Session,
    domain: u8,
    clock: HostClock,
    /// Numbers given to nodes and publishers.
    entities: u32,
    names: RosNames,
    of: BTreeMap<Arc<str>, PayloadNode>,
}

/// One payload.
struct PayloadNode {
    node: RosNode,
    name: String,
    run: Option<u32>,
    translator: RosTranslator,
    publishers: BTreeMap<String, RosPublisher>,
    _token: LivelinessToken,
}

/// One topic of a payload.
struct RosPublisher {
    publisher: Publisher<'static>,
    gid: [u8; 16],
    number: i64,
    latch: Option<Latch>,
    _token: LivelinessToken,
}

/// A message and its attachment.
type Message = (Vec<u8>, Vec<u8>);

/// The last message of a latched topic with its attachment, for late subscribers.
struct Latch {
    last: Arc<Mutex<Option<Message>>>,
    _answers: Queryable<()>,
    _token: LivelinessToken,
}

impl Nodes {
    /// What cannot be published is left out: Zenoh's session ended, or a payload has more names than the limit.
    fn take(&mut self, input: Input) {
        let mut records = Vec::new();
        let payload = match input {
            Input::Picture { payload, t, jpeg } => {
                let Some(node) = self.node(&payload, None) else { return };
                records.push(node.translator.thumbnail(t, &jpeg));
                payload
            }
            Input::Record { payload, run, topic, live, log, data } => {
                let Some(node) = self.node(&payload, Some((run, live))) else { return };
                if node.run != Some(run) {
                    return;
                }
                // A message that is none of its schema makes no message here; the mirror keeps it as it is.
                let _ = node.translator.output(&topic, log, &data, &mut records);
                payload
            }
        };
        for record in records {
            let _ = self.publish(&payload, &record);
        }
    }

    /// The payload's node, made with its first record. A live record of another run, or any of a later one, begins anew.
    fn node(&mut self, payload: &Arc<str>, of: Option<(u32, bool)>) -> Option<&mut PayloadNode> {
        if !self.of.contains_key(payload) {
            let name = self.names.of(payload)?;
            let node = RosNode {
                domain: self.domain,
                session: self.session.zid().to_string(),
                number: self.entities,
                namespace: format!("/{name}"),
                name: NODE.into(),
            };
            let token = self.session.liveliness().declare_token(node.token()).wait().ok()?;
            self.entities += 1;
            let node = PayloadNode {
                node,
                translator: RosTranslator::of_helicopter(&name),
                name,
                run: None,
                publishers: BTreeMap::new(),
                _token: token,
            };
            self.of.insert(Arc::clone(payload), node);
        }
        let node = self.of.get_mut(payload)?;
        let is_new = |(run, live): &(u32, bool)| node.run != Some(*run) && (*live || node.run < Some(*run));
        if let Some((run, _)) = of.filter(is_new) {
            node.run = Some(run);
            node.translator = RosTranslator::of_helicopter(&node.name);
        }
        Some(node)
    }

    fn publish(&mut self, payload: &Arc<str>, record: &RosRecord) -> zenoh::Result<()> {
        let (session, clock) = (&self.session, &self.clock);
        let Some(node) = self.of.get_mut(payload) else { return Ok(()) };
        if !node.publishers.contains_key(&record.topic) {
            let publisher = RosPublisher::declare(session, &node.node, self.entities, record)?;
            self.entities += 1;
            node.publishers.insert(record.topic.clone(), publisher);
        }
        match node.publishers.get_mut(&record.topic) {
            Some(publisher) => publisher.put(&record.data, clock.now()),
            None => Ok(()),
        }
    }
}

impl RosPublisher {
    fn declare(session: &Session, node: &RosNode, entity: u32, record: &RosRecord) -> zenoh::Result<Self> {
        let latched = record.is_latched();
        let key = topic_key(node.domain, &record.topic, record.kind);
        let publisher = session
            .declare_publisher(key.clone())
            .congestion_control(CongestionControl::Drop)
            .reliability(Reliability::Reliable)
            .wait()?;
        let latch = if latched { Some(Latch::declare(session, &key, entity)?) } else { None };
        let depth = if latched { 1 } else { DEPTH };
        let token = node.publisher_token(entity, &record.topic, record.kind, latched, depth);
        let gid = gid(&token);
        let token = session.liveliness().declare_token(token).wait()?;
        Ok(Self { publisher, gid, number: 0, latch, _token: token })
    }

    fn put(&mut self, data: &[u8], now: MonoTime) -> zenoh::Result<()> {
        self.number += 1;
        let attached = attachment(self.number, now.ns(), &self.gid);
        if let Some(latch) = &self.latch {
            *latch.last.lock().unwrap_or_else(PoisonError::into_inner) =
                Some((data.to_vec(), attached.clone()));
        }
        self.publisher.put(data).attachment(attached).wait()
    }
}

impl Latch {
    /// Zenoh's advanced subscribers find the publisher by a token of this name and ask it for its history there.
    fn declare(session: &Session, key: &str, entity: u32) -> zenoh::Result<Self> {
        let history = format!("{key}/@adv/pub/{}/{entity}/_", session.zid());
        let last: Arc<Mutex<Option<Message>>> = Arc::default();
        let (kept, key) = (Arc::clone(&last), key.to_owned());
        let answers = session
            .declare_queryable(history.clone())
            .complete(true)
            .callback(move |query| {
                let last = kept.lock().unwrap_or_else(PoisonError::into_inner).clone();
                if let Some((data, attached)) = last {
                    // The subscriber may be gone.
                    let _ = query.reply(&key, data).attachment(attached).wait();
                }
            })
            .wait()?;
        let token = session.liveliness().declare_token(history).wait()?;
        Ok(Self { last, _answers: answers, _token: token })
    }
}
