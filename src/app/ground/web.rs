//! The station's web server: the page, its live messages, GeoJSON, KML, thumbnails, map tiles.
//!
//! On loopback every user of this computer has access; elsewhere a token is required once and then kept in a cookie. On
//! loopback, host names other than addresses and `localhost` are refused, so that an Internet page cannot point its own
//! name here (DNS rebinding).

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use axum::Router;
use axum::body::Body;
use axum::extract::ws::{Message, WebSocket};
use axum::extract::{Path, Query, Request, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use tokio::sync::broadcast;
use tokio::time::Instant;

use super::feeds;
use super::listener::ClientListener;
use super::view::View;
use crate::app::openmetrics;

const INDEX: &str = include_str!("page/index.html");
const STYLE: &str = include_str!("page/style.css");
const MAP: &str = include_str!("page/map.js");
const ALARM: &str = include_str!("page/alarm.js");
const APP: &str = include_str!("page/app.js");
/// Name of the cookie that holds the token.
const COOKIE: &str = "windhover";
/// Nothing is loaded from other sites, and no other page may frame this one.
const POLICY: &str = "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; \
                      frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// The server's state.
#[derive(Clone)]
pub struct Web {
    /// What is shown.
    pub view: Arc<Mutex<View>>,
    /// Messages for the pages.
    pub live: broadcast::Sender<Arc<str>>,
    /// Folder with map tiles `Z/X/Y.png`.
    pub tiles: Option<PathBuf>,
    /// Position of the station, latitude and longitude in degrees.
    pub position: Option<[f64; 2]>,
    /// The token that a visitor must send; `None` on loopback.
    pub token: Option<Arc<str>>,
}

impl Web {
    fn view(&self) -> std::sync::MutexGuard<'_, View> {
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The routes.
    pub fn router(self) -> Router {
        Router::new()
            .route("/", get(|| async { text("text/html; charset=utf-8", INDEX) }))
            .route("/style.css", get(|| async { text("text/css; charset=utf-8", STYLE) }))
            .route("/map.js", get(|| async { text("text/javascript; charset=utf-8", MAP) }))
            .route("/alarm.js", get(|| async { text("text/javascript; charset=utf-8", ALARM) }))
            .route("/app.js", get(|| async { text("text/javascript; charset=utf-8", APP) }))
            .route("/live", get(live))
            .route("/thumbnail/{payload}", get(thumbnail))
            .route("/vehicles.geojson", get(geojson))
            .route("/vehicles.kml", get(kml))
            .route("/network.kml", get(network_link))
            .route("/metrics", get(metrics))
            .route("/tiles/{z}/{x}/{y}", get(tile))
            .layer(axum::middleware::from_fn_with_state(self.clone(), guard))
            .with_state(self)
    }
}

fn text(kind: &'static str, body: impl Into<Body>) -> Response {
    ([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-cache")], body.into()).into_response()
}

/// Compares in a time that does not depend on where they differ.
pub(super) fn same(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b)) == 0
}

fn cookie(headers: &HeaderMap) -> Option<&str> {
    let cookies = headers.get(header::COOKIE)?.to_str().ok()?;
    cookies.split(';').find_map(|c| c.trim().strip_prefix(COOKIE)?.strip_prefix('='))
}

/// The token in a request's address.
pub(super) fn query_token(request: &Request) -> Option<String> {
    let query = request.uri().query()?;
    query.split('&').find_map(|pair| Some(pair.strip_prefix("token=")?.to_owned()))
}

/// Whether a `Host` header names this computer, by address or as localhost.
fn is_local_name(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    name == "localhost" || name.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// Whether a page of another origin sent the request.
fn is_foreign(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    match (text(header::ORIGIN), text(header::HOST)) {
        (Some(origin), Some(host)) => {
            origin.strip_prefix("http://").or(origin.strip_prefix("https://")) != Some(host)
        }
        (Some(_), None) => true,
        (None, _) => false,
    }
}

async fn guard(State(web): State<Web>, request: Request, next: Next) -> Response {
    if is_foreign(request.headers()) {
        return (StatusCode::FORBIDDEN, "request of another site refused\n").into_response();
    }
    let mut set_cookie = None;
    match &web.token {
        None => {
            let host = request.headers().get(header::HOST).and_then(|h| h.to_str().ok()).unwrap_or_default();
            if !is_local_name(host) {
                return (StatusCode::FORBIDDEN, "use the address, or localhost\n").into_response();
            }
        }
        Some(token) => {
            let asked = query_token(&request);
            let given = asked.as_deref().is_some_and(|given| same(given, token));
            if !given && !cookie(request.headers()).is_some_and(|given| same(given, token)) {
                let words = "this station requires its token: open /?token=TOKEN as it was printed\n";
                return (StatusCode::UNAUTHORIZED, words).into_response();
            }
            if given {
                set_cookie =
                    HeaderValue::from_str(&format!("{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"))
                        .ok();
            }
        }
    }
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    if let Some(cookie) = set_cookie {
        headers.insert(header::SET_COOKIE, cookie);
    }
    response
}

async fn live(State(web): State<Web>, upgrade: WebSocketUpgrade) -> Response {
    upgrade.max_message_size(4 << 10).on_upgrade(move |socket| feed(web, socket))
}

/// Sends the known state, then all changes. A page that cannot keep up misses the oldest.
async fn feed(web: Web, mut socket: WebSocket) {
    let mut news = web.live.subscribe();
    let tiles = web.tiles.as_deref().map(deepest_tiles);
    let hello = serde_json::json!({"k": "hello", "tiles": tiles, "position": web.position}).to_string();
    let history = web.view().history();
    for message in std::iter::once(hello.as_str()).chain(history.iter().map(|m| &**m)) {
        if socket.send(Message::text(message)).await.is_err() {
            return;
        }
    }
    loop {
        tokio::select! {
            message = news.recv() => match message {
                Ok(message) => {
                    if socket.send(Message::text(&*message)).await.is_err() {
                        return;
                    }
                }
                Err(broadcast::error::RecvError::Lagged(_)) => {}
                Err(broadcast::error::RecvError::Closed) => return,
            },
            // Pages send nothing; their end shows here.
            said = socket.recv() => if !matches!(said, Some(Ok(_))) { return },
        }
    }
}

async fn thumbnail(State(web): State<Web>, Path(payload): Path<String>) -> Response {
    let picture = web.view().picture(&payload);
    match picture {
        Some(jpeg) => text("image/jpeg", jpeg.to_vec()),
        None => (StatusCode::NOT_FOUND, "no picture yet\n").into_response(),
    }
}

async fn geojson(State(web): State<Web>) -> Response {
    text("application/geo+json", feeds::geojson(&web.view().vehicles(Instant::now())))
}

async fn metrics(State(web): State<Web>) -> Response {
    text(openmetrics::CONTENT_TYPE, web.view().metrics(Instant::now()))
}

async fn kml(State(web): State<Web>) -> Response {
    text("application/vnd.google-earth.kml+xml", feeds::kml(&web.view().vehicles(Instant::now())))
}

#[derive(serde::Deserialize)]
struct Token {
    token: Option<String>,
}

async fn network_link(Query(query): Query<Token>, headers: HeaderMap) -> Response {
    let host = headers.get(header::HOST).and_then(|h| h.to_str().ok()).unwrap_or("localhost");
    // A KML viewer keeps no cookies: the token of its request goes into its link.
    let token = query.token.map_or_else(String::new, |token| format!("?token={token}"));
    let url = format!("http://{host}/vehicles.kml{token}");
    text("application/vnd.google-earth.kml+xml", feeds::network_link(&url))
}

async fn tile(State(web): State<Web>, Path((z, x, y)): Path<(u32, u32, u32)>) -> Response {
    let found = web.tiles.and_then(|dir| {
        let column = dir.join(z.to_string()).join(x.to_string());
        [("png", "image/png"), ("jpg", "image/jpeg"), ("webp", "image/webp")]
            .into_iter()
            .find_map(|(end, kind)| Some((kind, std::fs::read(column.join(format!("{y}.{end}"))).ok()?)))
    });
    match found {
        Some((kind, bytes)) => text(kind, bytes),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

/// The deepest zoom level in a folder of tiles.
fn deepest_tiles(dir: &std::path::Path) -> u32 {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).max().unwrap_or(0)
}

/// Serves until the program ends.
pub async fn serve(listener: tokio::net::TcpListener, web: Web) -> std::io::Result<()> {
    axum::serve(ClientListener::new(listener, "page"), web.router()).await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_computer_by_its_own_names() {
        for good in ["localhost", "localhost:8080", "127.0.0.1:8080", "[::1]:8080", "127.0.0.1"] {
            assert!(is_local_name(good), "{good}");
        }
        for bad in
            ["", "evil.example", "localhost.evil.example", "10.0.0.1", "[::2]:80", "[", "127.0.0.1.evil"]
        {
            assert!(!is_local_name(bad), "{bad}");
        }
    }

    #[test]
    fn cookies_are_found_among_others_and_compared_whole() {
        let mut headers = HeaderMap::new();
        headers.insert(header::COOKIE, HeaderValue::from_static("a=b; windhover=secret; c=d"));
        assert_eq!(cookie(&headers), Some("secret"));
        assert!(same("secret", "secret") && !same("secret", "secre") && !same("secret", "Secret"));
    }

    #[test]
    fn other_origins_are_foreign() {
        let of = |origin: &'static str, host: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ORIGIN, HeaderValue::from_static(origin));
            headers.insert(header::HOST, HeaderValue::from_static(host));
            is_foreign(&headers)
        };
        assert!(!of("http://127.0.0.1:8080", "127.0.0.1:8080"));
        assert!(of("http://evil.example", "127.0.0.1:8080") && of("null", "127.0.0.1:8080"));
    }
}
