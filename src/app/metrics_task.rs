//! The metrics task: answers requests on loopback for the daemon's health as OpenMetrics, one at a time, with a short
//! time limit.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

use super::context::TaskContext;
use super::events::OperatorEvent;
use super::openmetrics::{self, PayloadMetrics};
use super::sinks::LatestHealth;
use super::supervise::Heartbeat;

/// Time limit of a request and its answer.
const BRIEFLY: Duration = Duration::from_secs(2);
/// Longest request.
const QUESTION: usize = 8 << 10;
/// Pause before the port is opened again.
const PAUSE: Duration = Duration::from_secs(5);

/// Answers until a stop is requested.
pub async fn run(address: SocketAddr, latest: LatestHealth, context: TaskContext, heartbeat: Heartbeat) {
    tokio::select! {
        () = context.stop.cancelled() => {}
        () = serve(address, &latest, &heartbeat) => {}
    }
}

async fn serve(address: SocketAddr, latest: &LatestHealth, heartbeat: &Heartbeat) {
    let mut reported = false;
    let listener = loop {
        match TcpListener::bind(address).await {
            Ok(listener) => break listener,
            Err(error) => {
                if !std::mem::replace(&mut reported, true) {
                    let words = format!("cannot listen on {address}: {error}; tried again");
                    OperatorEvent::LinkFault.emit("metrics", words);
                }
                heartbeat.while_waiting(tokio::time::sleep(PAUSE)).await;
            }
        }
    };
    loop {
        match heartbeat.while_waiting(listener.accept()).await {
            Ok((stream, _)) => {
                // A client that is too slow or leaves gets no answer.
                let _ = heartbeat.while_waiting(tokio::time::timeout(BRIEFLY, answer(stream, latest))).await;
            }
            Err(_) => heartbeat.while_waiting(tokio::time::sleep(PAUSE)).await,
        }
    }
}

async fn answer(mut stream: TcpStream, latest: &LatestHealth) -> std::io::Result<()> {
    let mut question = Vec::new();
    while !question.windows(4).any(|end| end == b"\r\n\r\n") {
        let mut part = [0; 1024];
        let got = stream.read(&mut part).await?;
        question.extend_from_slice(&part[..got]);
        if got == 0 || question.len() > QUESTION {
            return Ok(());
        }
    }
    let (status, body) = match question.strip_prefix(b"GET /metrics") {
        Some([b' ' | b'?', ..]) => ("200 OK", text(latest)),
        _ => ("404 Not Found", "request /metrics\n".into()),
    };
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        openmetrics::CONTENT_TYPE,
        body.len()
    );
    stream.write_all(head.as_bytes()).await?;
    stream.write_all(body.as_bytes()).await?;
    stream.shutdown().await
}

fn text(latest: &LatestHealth) -> String {
    let health = latest.get();
    let payloads =
        health.iter().map(|health| PayloadMetrics { payload: "", health, age_s: None, link: None });
    openmetrics::render(&payloads.collect::<Vec<_>>())
}
