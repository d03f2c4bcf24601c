//! Received records for Foxglove over its WebSocket: every topic of every payload, with the flight's schemas.
//!
//! The protocol is `foxglove.sdk.v1` (and its older name `foxglove.websocket.v1`): the server sends its name and its
//! channels as JSON, a client subscribes, messages are binary frames. Topics are `/PAYLOAD/TOPIC`; in addition to the
//! flight's topics there are `/PAYLOAD/target/NAME/location`, which a map panel draws, and `/PAYLOAD/camera/thumbnail`.
//! Back-filled records of live topics are left out: a live viewer takes the latest message for the newest.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::Router;
use axum::extract::ws::{Message, WebSocket};
use axum::extract::{Request, State, WebSocketUpgrade};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use base64::Engine as _;
use bytes::{BufMut as _, Bytes, BytesMut};
use prost::Message as _;
use serde_json::{Value, json};
use tokio::sync::broadcast;

use super::listener::ClientListener;
use super::web::{query_token, same};
use crate::io::link::{Arrival, Class, downlink_class};
use crate::io::proto::link::Thumbnail;
use crate::io::proto::{foxglove as fox, schema_of_package, timestamp, windhover as wh};
use crate::io::records::topic;
use windhover_base::time::MonoTime;

/// Names of the protocol that clients ask for.
const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// First byte of a message's frame.
const MESSAGE_DATA: u8 = 1;
/// Messages a client may be behind before it misses some.
const QUEUE: usize = 1_024;
/// Most channels that are advertised: a payload cannot make an unlimited number of topics.
const CHANNELS: usize = 4_096;
/// Subscriptions of one client.
const SUBSCRIPTIONS: usize = 4_096;
/// Longest message of a client, bytes.
const CLIENT_LIMIT: usize = 256 << 10;

/// One message of a channel.
#[derive(Clone)]
struct ChannelMessage {
    channel: u64,
    time_ns: u64,
    data: Bytes,
}

struct FoxgloveChannel {
    topic: String,
    schema_name: String,
    schema: Arc<[u8]>,
    last: Option<ChannelMessage>,
}

impl FoxgloveChannel {
    fn advertised(&self, id: u64) -> Value {
        json!({"id": id, "topic": self.topic, "encoding": "protobuf", "schemaName": self.schema_name,
            "schemaEncoding": "protobuf",
            "schema": base64::engine::general_purpose::STANDARD.encode(&self.schema)})
    }
}

#[derive(Clone)]
enum News {
    Channel(u64),
    Message(ChannelMessage),
}

#[derive(Default)]
struct Channels {
    /// The channel of a number is at the number less one.
    all: Vec<FoxgloveChannel>,
    numbers: HashMap<(String, String), u64>,
    schemas: BTreeMap<String, Arc<[u8]>>,
}

/// What every client receives.
#[derive(Clone)]
pub struct Scope {
    channels: Arc<Mutex<Channels>>,
    news: broadcast::Sender<News>,
}

impl Default for Scope {
    fn default() -> Self {
        Self { channels: Arc::default(), news: broadcast::Sender::new(QUEUE) }
    }
}

impl Scope {
    fn channels(&self) -> MutexGuard<'_, Channels> {
        self.channels.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a record that arrived.
    pub fn record(&self, arrival: &Arrival) {
        let channel = &arrival.channel;
        let comes_live = downlink_class(&channel.topic).is_none_or(|class| class != Class::Later);
        if !arrival.live && comes_live && !is_kept(&channel.topic) {
            return;
        }
        let name = format!("/{}{}", arrival.payload, channel.topic);
        self.publish(&name, &channel.schema_name, &channel.schema, arrival.publish_time, &arrival.data);
        let is_state = channel.schema_name == "windhover.TargetState" && topic::is_target_now(&channel.topic);
        let state = is_state.then(|| wh::TargetState::decode(&arrival.data[..]).ok()).flatten();
        if let Some(fix) = state.as_ref().and_then(location) {
            let target = name.rsplit_once('/').map_or(&*name, |(target, _)| target);
            self.publish(
                &format!("{target}/location"),
                "foxglove.LocationFix",
                &[],
                arrival.publish_time,
                &fix.encode_to_vec(),
            );
        }
    }

    /// Takes a picture.
    pub fn thumbnail(&self, payload: &str, thumbnail: &Thumbnail) {
        let t = MonoTime::from_ns(thumbnail.time_ns);
        let image = fox::CompressedImage {
            timestamp: Some(timestamp(t)),
            frame_id: "camera".into(),
            data: thumbnail.jpeg.clone(),
            format: "jpeg".into(),
        };
        let topic = format!("/{payload}/camera/thumbnail");
        self.publish(&topic, "foxglove.CompressedImage", &[], t, &image.encode_to_vec());
    }

    /// A message of a topic; an empty schema stands for the program's own schema of this name.
    fn publish(&self, topic: &str, schema_name: &str, schema: &[u8], t: MonoTime, data: &[u8]) {
        let mut channels = self.channels();
        let Some(channel) = channels.number(topic, schema_name, schema, &self.news) else { return };
        let time_ns = u64::try_from(t.ns()).unwrap_or(0);
        let said = ChannelMessage { channel, time_ns, data: Bytes::copy_from_slice(data) };
        channels.all[channel as usize - 1].last = Some(said.clone());
        // There may be no client.
        let _ = self.news.send(News::Message(said));
    }
}

impl Channels {
    /// The number of a topic's channel, which is made and advertised where it is new; `None` where there are too many.
    fn number(
        &mut self,
        topic: &str,
        schema_name: &str,
        schema: &[u8],
        news: &broadcast::Sender<News>,
    ) -> Option<u64> {
        let key = (topic.to_owned(), schema_name.to_owned());
        if let Some(number) = self.numbers.get(&key) {
            return Some(*number);
        }
        if self.all.len() >= CHANNELS {
            return None;
        }
        let schema = match (schema, schema_name.split_once('.')) {
            ([], Some((package, _))) => {
                let own = || schema_of_package(package).into();
                Arc::clone(self.schemas.entry(package.to_owned()).or_insert_with(own))
            }
            (schema, _) => schema.into(),
        };
        self.all.push(FoxgloveChannel {
            topic: key.0.clone(),
            schema_name: key.1.clone(),
            schema,
            last: None,
        });
        let number = self.all.len() as u64;
        self.numbers.insert(key, number);
        let _ = news.send(News::Channel(number));
        Some(number)
    }
}

/// Topics of lasting content: the latest message counts, live or back-filled.
fn is_kept(topic: &str) -> bool {
    downlink_class(topic) == Some(Class::Event)
}

/// A vehicle's place as a map panel draws it; `None` while it is not known.
fn location(state: &wh::TargetState) -> Option<fox::LocationFix> {
    use fox::location_fix::PositionCovarianceType as Kind;
    // (north, east) in the state, (east, north, up) here.
    let (covariance, kind) = match state.covariance[..] {
        [nn, ne, _, _, _, ee, ..] => (vec![ee, ne, 0.0, ne, nn, 0.0, 0.0, 0.0, 0.0], Kind::Approximated),
        _ => (Vec::new(), Kind::Unknown),
    };
    state.known.then(|| fox::LocationFix {
        timestamp: state.timestamp,
        frame_id: format!("target/{}", state.target),
        latitude: state.lat_deg,
        longitude: state.lon_deg,
        position_covariance: covariance,
        position_covariance_type: kind.into(),
        ..Default::default()
    })
}

/// The server's state.
#[derive(Clone)]
pub struct Server {
    /// What clients receive.
    pub scope: Scope,
    /// The token that a client must send (`?token=` in its address); without one, only Foxglove and pages of this
    /// computer may connect.
    pub token: Option<Arc<str>>,
}

/// Whether the requesting page is Foxglove's or of this computer; programs send no origin.
fn is_welcome(headers: &HeaderMap) -> bool {
    let Some(origin) = headers.get(header::ORIGIN) else { return true };
    let Some((scheme, rest)) = origin.to_str().ok().and_then(|o| o.split_once("://")) else { return false };
    let host = rest.split([':', '/']).next().unwrap_or_default();
    match scheme {
        "file" => true,
        "https" if host == "foxglove.dev" || host.ends_with(".foxglove.dev") => true,
        "http" | "https" => rest.starts_with("[::1]") || matches!(host, "localhost" | "127.0.0.1"),
        _ => false,
    }
}

async fn guard(State(server): State<Server>, request: Request, next: Next) -> Response {
    let known = match &server.token {
        Some(token) => query_token(&request).is_some_and(|given| same(&given, token)),
        None => is_welcome(request.headers()),
    };
    if known { next.run(request).await } else { StatusCode::FORBIDDEN.into_response() }
}

async fn upgrade(State(server): State<Server>, upgrade: WebSocketUpgrade) -> Response {
    let upgrade = upgrade.protocols(PROTOCOLS).max_message_size(CLIENT_LIMIT);
    if upgrade.selected_protocol().is_none() {
        return (StatusCode::BAD_REQUEST, "request foxglove.sdk.v1\n").into_response();
    }
    upgrade.on_upgrade(move |socket| async move {
        // The client has left, whatever the reason.
        let _ = Client::new(socket).serve(&server.scope).await;
    })
}

struct Client {
    socket: WebSocket,
    /// Channel of each subscription.
    subscriptions: BTreeMap<u32, u64>,
}

impl Client {
    fn new(socket: WebSocket) -> Self {
        Self { socket, subscriptions: BTreeMap::new() }
    }

    async fn serve(&mut self, scope: &Scope) -> Result<(), axum::Error> {
        let mut news = scope.news.subscribe();
        let info = json!({"op": "serverInfo", "name": "windhover ground", "capabilities": [],
            "supportedEncodings": [], "metadata": {}});
        self.tell(&info).await?;
        let all: Vec<_> = {
            let channels = scope.channels();
            channels.all.iter().zip(1..).map(|(channel, id)| channel.advertised(id)).collect()
        };
        let mut advertised = all.len() as u64;
        self.tell(&json!({"op": "advertise", "channels": all})).await?;
        loop {
            tokio::select! {
                message = news.recv() => match message {
                    Ok(News::Channel(id)) if id > advertised => {
                        advertised = self.advertise(scope, advertised).await?;
                    }
                    Ok(News::Channel(_)) => {}
                    Ok(News::Message(said)) => self.send(&said).await?,
                    // The client missed some messages; channels must not be among them.
                    Err(broadcast::error::RecvError::Lagged(_)) => advertised = self.advertise(scope, advertised).await?,
                    Err(broadcast::error::RecvError::Closed) => return Ok(()),
                },
                said = self.socket.recv() => match said {
                    Some(Ok(Message::Text(text))) => self.listen(scope, &text).await?,
                    Some(Ok(Message::Close(_)) | Err(_)) | None => return Ok(()),
                    Some(Ok(_)) => {}
                },
            }
        }
    }

    /// Advertises channels after number `advertised`; returns the last.
    async fn advertise(&mut self, scope: &Scope, advertised: u64) -> Result<u64, axum::Error> {
        let fresh: Vec<_> = {
            let channels = scope.channels();
            let numbered = channels.all.iter().zip(1..).skip(advertised as usize);
            numbered.map(|(channel, id)| channel.advertised(id)).collect()
        };
        let last = advertised + fresh.len() as u64;
        if last > advertised {
            self.tell(&json!({"op": "advertise", "channels": fresh})).await?;
        }
        Ok(last)
    }

    async fn tell(&mut self, message: &Value) -> Result<(), axum::Error> {
        self.socket.send(Message::text(message.to_string())).await
    }

    async fn send(&mut self, said: &ChannelMessage) -> Result<(), axum::Error> {
        let wanted: Vec<u32> =
            self.subscriptions.iter().filter(|(_, c)| **c == said.channel).map(|(id, _)| *id).collect();
        for id in wanted {
            self.socket.send(Message::Binary(frame(id, said))).await?;
        }
        Ok(())
    }

    /// Handles a client's request; a message that is not a request of the protocol is ignored. A new subscription gets
    /// the channel's latest message at once.
    async fn listen(&mut self, scope: &Scope, text: &str) -> Result<(), axum::Error> {
        for request in requests(text) {
            match request {
                SignalRequest::Subscribe { id, channel } if self.subscriptions.len() < SUBSCRIPTIONS => {
                    self.subscriptions.insert(id, channel);
                    let at = usize::try_from(channel).ok().and_then(|n| n.checked_sub(1));
                    let last = at.and_then(|at| scope.channels().all.get(at)?.last.clone());
                    if let Some(last) = last {
                        self.socket.send(Message::Binary(frame(id, &last))).await?;
                    }
                }
                SignalRequest::Subscribe { .. } => {}
                SignalRequest::Unsubscribe { id } => {
                    self.subscriptions.remove(&id);
                }
            }
        }
        Ok(())
    }
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum SignalRequest {
    Subscribe { id: u32, channel: u64 },
    Unsubscribe { id: u32 },
}

fn requests(text: &str) -> Vec<SignalRequest> {
    let Ok(message) = serde_json::from_str::<Value>(text) else { return Vec::new() };
    let id = |value: &Value| u32::try_from(value.as_u64()?).ok();
    let list = |name: &str| message[name].as_array().cloned().unwrap_or_default();
    match message["op"].as_str() {
        Some("subscribe") => {
            let one = |s: &Value| {
                Some(SignalRequest::Subscribe { id: id(&s["id"])?, channel: s["channelId"].as_u64()? })
            };
            list("subscriptions").iter().filter_map(one).collect()
        }
        Some("unsubscribe") => {
            let one = |s: &Value| Some(SignalRequest::Unsubscribe { id: id(s)? });
            list("subscriptionIds").iter().filter_map(one).collect()
        }
        _ => Vec::new(),
    }
}

/// The binary frame of a message: kind, subscription, time, little-endian, then the message.
fn frame(subscription: u32, said: &ChannelMessage) -> Bytes {
    let mut bytes = BytesMut::with_capacity(13 + said.data.len());
    bytes.put_u8(MESSAGE_DATA);
    bytes.put_u32_le(subscription);
    bytes.put_u64_le(said.time_ns);
    bytes.put_slice(&said.data);
    bytes.freeze()
}

/// Serves until the program ends.
pub async fn serve(listener: tokio::net::TcpListener, server: Server) -> std::io::Result<()> {
    let router = Router::new()
        .route("/", get(upgrade))
        .layer(axum::middleware::from_fn_with_state(server.clone(), guard))
        .with_state(server);
    axum::serve(ClientListener::new(listener, "foxglove"), router).await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn foxglove_programs_and_this_computer_are_welcome_and_other_pages_are_not() {
        let from = |origin: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ORIGIN, axum::http::HeaderValue::from_static(origin));
            is_welcome(&headers)
        };
        assert!(is_welcome(&HeaderMap::new()));
        for good in [
            "https://app.foxglove.dev",
            "http://localhost:8080",
            "http://127.0.0.1",
            "http://[::1]:80",
            "file://",
        ] {
            assert!(from(good), "{good}");
        }
        for bad in [
            "http://app.foxglove.dev",
            "https://foxglove.dev.evil.example",
            "https://evilfoxglove.dev",
            "http://localhost.evil.example",
            "https://evil.example/localhost",
            "null",
        ] {
            assert!(!from(bad), "{bad}");
        }
    }

    #[test]
    fn requests_are_read_and_everything_else_is_passed_over() {
        let two = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":2},{"id":-1,"channelId":2}]}"#;
        assert_eq!(requests(two), [SignalRequest::Subscribe { id: 7, channel: 2 }]);
        assert_eq!(
            requests(r#"{"op":"unsubscribe","subscriptionIds":[7,"x"]}"#),
            [SignalRequest::Unsubscribe { id: 7 }]
        );
        for other in ["", "[]", "{", "7", r#"{"op":"subscribe"}"#, r#"{"op":7}"#, r#"{"op":"advertise"}"#] {
            assert_eq!(requests(other), [], "{other}");
        }
    }

    proptest::proptest! {
        #[test]
        fn any_text_is_read_without_harm(text in ".{0,200}") {
            let _ = requests(&text);
        }
    }
}
