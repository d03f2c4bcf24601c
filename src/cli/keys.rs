//! `windhover keys …`: the certificates of the wireless link.

use std::path::{Path, PathBuf};

use clap::{Args as ClapArgs, Subcommand};

use super::{CliError, CliResult};
use crate::cli::out::outln;
use crate::io::link::keys::{Authority, Role};
use windhover_base::time::{NS_PER_S, UtcTime};

/// Make the certificates by which payloads and ground stations authenticate each other.
///
/// Make the authority once, keep its directory in a safe place, and copy to each payload or station only its own
/// certificate and key, authority.pem and revoked.pem.
#[derive(ClapArgs, Debug)]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand, Debug)]
enum Action {
    /// Make the authority that signs all others
    Authority {
        #[command(flatten)]
        place: Place,
        /// Name in its certificate
        #[arg(long, default_value = "windhover authority")]
        name: String,
        /// Days until it expires
        #[arg(long, default_value_t = 7_300, value_parser = clap::value_parser!(i64).range(1..=36_500))]
        days: i64,
    },
    /// Make certificate and key of a payload
    Payload(Issue),
    /// Make certificate and key of a ground station
    Station(Issue),
    /// Put a payload or station on the revocation list
    Revoke {
        /// Role
        #[arg(value_parser = ["payload", "station"])]
        role: String,
        /// Its name
        name: String,
        #[command(flatten)]
        place: Place,
    },
    /// List payloads and stations with their expiry
    List(Place),
}

#[derive(ClapArgs, Debug)]
struct Place {
    /// Directory of the authority
    #[arg(long, value_name = "DIR", default_value = "keys")]
    dir: PathBuf,
}

#[derive(ClapArgs, Debug)]
struct Issue {
    /// Name: letters, digits and -
    name: String,
    #[command(flatten)]
    place: Place,
    /// Days until it expires
    #[arg(long, default_value_t = 730, value_parser = clap::value_parser!(i64).range(1..=36_500))]
    days: i64,
}

pub(super) fn run(args: &Args) -> CliResult {
    let now = wall_clock();
    match &args.action {
        Action::Authority { place, name, days } => {
            let authority = Authority::at(&place.dir);
            authority.create(name, *days, now)?;
            outln!("authority in {}: keep authority.key in a safe place", place.dir.display())?;
            Ok(())
        }
        Action::Payload(issue) => make(Role::Payload, issue, now),
        Action::Station(issue) => make(Role::Station, issue, now),
        Action::Revoke { role, name, place } => {
            let role = if role == "payload" { Role::Payload } else { Role::Station };
            let authority = Authority::at(&place.dir);
            authority.revoke(role, name, now)?;
            outln!(
                "{} {name} revoked: copy {} to every payload and station",
                role.name(),
                authority.revoked_file().display()
            )?;
            Ok(())
        }
        Action::List(place) => list(&place.dir, now),
    }
}

fn make(role: Role, issue: &Issue, now: UtcTime) -> CliResult {
    let authority = Authority::at(&issue.place.dir);
    let (certificate, key) = authority.issue(role, &issue.name, issue.days, now)?;
    outln!("certificate {}", certificate.display())?;
    outln!("key         {}", key.display())?;
    outln!("authority   {}", authority.certificate_file().display())?;
    outln!("revoked     {}", authority.revoked_file().display())?;
    Ok(())
}

fn list(dir: &Path, now: UtcTime) -> CliResult {
    let authority = Authority::at(dir);
    if !authority.certificate_file().exists() {
        return Err(CliError::failed(format!(
            "{}: there is no authority here; make one with `windhover keys authority`",
            dir.display()
        )));
    }
    for member in authority.members()? {
        let state = match (member.revoked, member.expires < now) {
            (true, _) => "revoked",
            (false, true) => "expired",
            (false, false) => "valid",
        };
        outln!("{:8} {:24} {state:8} until {}", member.role.name(), member.name, member.expires)?;
    }
    Ok(())
}

/// The date, for the validity of certificates.
fn wall_clock() -> UtcTime {
    let seconds = rustls::pki_types::UnixTime::now().as_secs();
    UtcTime::from_unix_ns(i64::try_from(seconds).unwrap_or(i64::MAX).saturating_mul(NS_PER_S))
}
