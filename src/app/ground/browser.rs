//! Opens the station's page in the desktop's browser.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::process::Stdio;

use super::terminal::Terminal;

/// The address at which this computer reaches a page that is served at `address`: loopback for a page that is served on
/// every address.
pub(super) fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        address.set_ip(match address {
            SocketAddr::V4(_) => Ipv4Addr::LOCALHOST.into(),
            SocketAddr::V6(_) => Ipv6Addr::LOCALHOST.into(),
        });
    }
    address
}

/// Opens `url` with the desktop's `xdg-open`; a line reports where it cannot.
pub(super) async fn open(url: String, terminal: Terminal) -> std::io::Result<()> {
    let mut command = tokio::process::Command::new("xdg-open");
    command.arg(&url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    match command.status().await {
        Ok(status) if status.success() => {}
        _ => terminal.line(format_args!("no browser can be opened here: open {url}")),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_on_every_address_is_opened_on_loopback() {
        for (served, opened) in
            [("0.0.0.0:8080", "127.0.0.1:8080"), ("[::]:80", "[::1]:80"), ("10.0.0.7:8080", "10.0.0.7:8080")]
        {
            let served: SocketAddr = served.parse().expect("an address");
            assert_eq!(reachable(served).to_string(), opened);
        }
    }
}
