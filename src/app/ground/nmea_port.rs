//! The port that sends the vehicles to plotters: RMC and GGA over TCP.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::sync::broadcast;
use tokio::time::Instant;

use super::listener::{ClientListener, ClientStream};
use super::view::View;
use super::{feeds, lock};

/// Shortest time between two sentences.
const EVERY: Duration = Duration::from_millis(200);
/// A plotter that accepts nothing for this long is disconnected.
const PATIENCE: Duration = Duration::from_secs(10);
/// Sentences that a plotter may be behind before it misses some.
const QUEUE: usize = 64;

/// Sends sentences of every vehicle whose state is new, and once a second of one that is lost, to every plotter.
pub(super) async fn serve(mut listener: ClientListener, view: Arc<Mutex<View>>) -> std::io::Result<()> {
    let sentences = broadcast::Sender::<Arc<str>>::new(QUEUE);
    let accept = async {
        loop {
            let (mut plotter, _) = listener.next().await;
            plotter.listens();
            tokio::spawn(attend(plotter, sentences.subscribe()));
        }
    };
    tokio::select! {
        () = produce(&sentences, &view) => Ok(()),
        never = accept => never,
    }
}

async fn produce(sentences: &broadcast::Sender<Arc<str>>, view: &Mutex<View>) {
    let mut sent = BTreeMap::new();
    loop {
        tokio::time::sleep(EVERY).await;
        for vehicle in lock(view).vehicles(Instant::now()) {
            let key = (vehicle.payload.clone(), vehicle.target.clone());
            // A lost vehicle is due again when its age in whole seconds changes.
            let lost = (!vehicle.is_current()).then(|| vehicle.age.s() as u64);
            let now = (vehicle.state.timestamp, lost);
            if sent.insert(key, now) != Some(now) {
                // There may be no receiver.
                let _ = sentences.send(feeds::nmea(&vehicle).into());
            }
        }
    }
}

/// Serves one plotter until it leaves or stops reading. What it sends is ignored.
async fn attend(mut plotter: ClientStream, mut news: broadcast::Receiver<Arc<str>>) {
    let mut ignored = [0; 256];
    loop {
        tokio::select! {
            said = plotter.read(&mut ignored) => if !matches!(said, Ok(1..)) { return },
            text = news.recv() => match text {
                Ok(text) => {
                    let sent = tokio::time::timeout(PATIENCE, plotter.write_all(text.as_bytes())).await;
                    if !matches!(sent, Ok(Ok(()))) {
                        return;
                    }
                    plotter.listens();
                }
                Err(broadcast::error::RecvError::Lagged(_)) => {}
                Err(broadcast::error::RecvError::Closed) => return,
            },
        }
    }
}
