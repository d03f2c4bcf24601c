//! A small certificate authority: payloads and stations authenticate each other by certificates that it signed.
//!
//! It is one directory: `authority.pem` and `authority.key`, the revocation list `revoked.pem`, and a certificate and
//! key for each member (`payload-NAME.pem`, `payload-NAME.key`). Private keys are written with mode 0600 and refused
//! with a wider mode.

use std::io::Write as _;
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DistinguishedName, DnType,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose, RevocationReason,
    RevokedCertParams, SanType, SerialNumber,
};
use ring::rand::SecureRandom as _;

use windhover_base::time::{Civil, NS_PER_S, UtcTime};

/// Domain under which every certificate carries its role and name.
const DOMAIN: &str = "windhover";

/// The role that a certificate gives its holder.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Role {
    /// The flying side, which sends estimates.
    Payload,
    /// The ground side, which receives them.
    Station,
}

impl Role {
    /// Its name in files and certificates.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Payload => "payload",
            Self::Station => "station",
        }
    }

    /// The other side of a link.
    pub const fn peer(self) -> Self {
        match self {
            Self::Payload => Self::Station,
            Self::Station => Self::Payload,
        }
    }

    /// The server name every certificate of this role carries.
    pub fn server_name(self) -> String {
        format!("{}.{DOMAIN}", self.name())
    }
}

/// Why keys could not be made or used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// A file could not be read or written.
    #[error("cannot {action} {}: {source}", path.display())]
    File {
        /// `read` or `write`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A private key is readable by others than its owner.
    #[error("private key {} is open to others (mode {mode:03o}): chmod 600 it", path.display())]
    Loose {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The file exists already.
    #[error("{} exists already; remove it or choose another name or directory", .0.display())]
    Exists(PathBuf),
    /// A file has the wrong content.
    #[error("{}: {what}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A name that is not allowed in a certificate.
    #[error("name {0:?}: use letters, digits and - only, at most 40 of them")]
    Name(String),
    /// The clock of this computer is not set.
    #[error("this computer's clock shows {0}: set it before making certificates")]
    ClockNotSet(String),
    /// The cryptography library failed.
    #[error("cannot make a certificate: {0}")]
    Crypto(String),
}

fn crypto(error: impl std::fmt::Display) -> KeyError {
    KeyError::Crypto(error.to_string())
}

/// A member of the authority, from its directory.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Member {
    /// Payload or station.
    pub role: Role,
    /// Its name.
    pub name: String,
    /// Certificate's file.
    pub file: PathBuf,
    /// Last instant at which it is valid.
    pub expires: UtcTime,
    /// Whether it is on the revocation list.
    pub revoked: bool,
}

/// The directory of an authority.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Authority {
    dir: PathBuf,
}

impl Authority {
    /// The authority in `dir`, which need not exist yet.
    pub fn at(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into() }
    }

    /// Its certificate.
    pub fn certificate_file(&self) -> PathBuf {
        self.dir.join("authority.pem")
    }

    /// Its private key.
    pub fn key_file(&self) -> PathBuf {
        self.dir.join("authority.key")
    }

    /// Its revocation list.
    pub fn revoked_file(&self) -> PathBuf {
        self.dir.join("revoked.pem")
    }

    /// A member's certificate and private key.
    pub fn member_files(&self, role: Role, name: &str) -> (PathBuf, PathBuf) {
        let stem = format!("{}-{name}", role.name());
        (self.dir.join(format!("{stem}.pem")), self.dir.join(format!("{stem}.key")))
    }

    /// Makes the authority: its key, its certificate, an empty revocation list.
    pub fn create(&self, name: &str, days: i64, now: UtcTime) -> Result<(), KeyError> {
        let (pem, key_file) = (self.certificate_file(), self.key_file());
        for path in [&pem, &key_file] {
            if path.exists() {
                return Err(KeyError::Exists(path.clone()));
            }
        }
        std::fs::create_dir_all(&self.dir).map_err(|source| KeyError::File {
            action: "write",
            path: self.dir.clone(),
            source,
        })?;
        let key = KeyPair::generate_for(&rcgen::PKCS_ED25519).map_err(crypto)?;
        let mut params = params(name, days, now)?;
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let certificate = params.self_signed(&key).map_err(crypto)?;
        write_key(&key_file, &key)?;
        write_file(&pem, certificate.pem().as_bytes(), 0o644)?;
        self.write_revoked(&[], now)
    }

    /// Makes the certificate and key of a member; gives their files.
    pub fn issue(
        &self,
        role: Role,
        name: &str,
        days: i64,
        now: UtcTime,
    ) -> Result<(PathBuf, PathBuf), KeyError> {
        check_name(name)?;
        let (pem, key_file) = self.member_files(role, name);
        for path in [&pem, &key_file] {
            if path.exists() {
                return Err(KeyError::Exists(path.clone()));
            }
        }
        let issuer = self.issuer()?;
        let key = KeyPair::generate_for(&rcgen::PKCS_ED25519).map_err(crypto)?;
        let mut params = params(name, days, now)?;
        for dns in [role.server_name(), format!("{}.{}", name.to_lowercase(), role.server_name())] {
            params.subject_alt_names.push(SanType::DnsName(dns.try_into().map_err(crypto)?));
        }
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
        params.use_authority_key_identifier_extension = true;
        let certificate = params.signed_by(&key, &issuer).map_err(crypto)?;
        write_key(&key_file, &key)?;
        write_file(&pem, certificate.pem().as_bytes(), 0o644)?;
        Ok((pem, key_file))
    }

    /// Puts a member's certificate on the revocation list.
    pub fn revoke(&self, role: Role, name: &str, now: UtcTime) -> Result<(), KeyError> {
        check_name(name)?;
        let (pem, _) = self.member_files(role, name);
        let serial = serial_of(&read_der(&pem)?)
            .ok_or_else(|| KeyError::Unreadable { path: pem, what: "not a certificate".into() })?;
        let mut serials = self.revoked_serials()?;
        if !serials.contains(&serial) {
            serials.push(serial);
        }
        self.write_revoked(&serials, now)
    }

    /// Every member with a certificate in the directory, sorted by role and name.
    pub fn members(&self) -> Result<Vec<Member>, KeyError> {
        let revoked = self.revoked_serials()?;
        let failed = |source| KeyError::File { action: "read", path: self.dir.clone(), source };
        let mut members = Vec::new();
        for entry in std::fs::read_dir(&self.dir).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.extension().is_none_or(|e| e != "pem") {
                continue;
            }
            let Ok(der) = read_der(&path) else { continue };
            let Some((role, name)) = peer_of(&der) else { continue };
            let serial = serial_of(&der).unwrap_or_default();
            let expires = expiry_of(&der).unwrap_or_default();
            members.push(Member { role, name, file: path, expires, revoked: revoked.contains(&serial) });
        }
        members.sort_by(|a, b| (a.role, &a.name).cmp(&(b.role, &b.name)));
        Ok(members)
    }

    fn issuer(&self) -> Result<Issuer<'static, KeyPair>, KeyError> {
        let pem = self.certificate_file();
        if !pem.exists() {
            return Err(KeyError::Unreadable {
                path: pem,
                what: "there is no authority here; make one with `windhover keys authority`".into(),
            });
        }
        let key = KeyPair::from_pem(&read_private(&self.key_file())?)
            .map_err(|e| KeyError::Unreadable { path: self.key_file(), what: e.to_string() })?;
        let text = read(&pem)?;
        Issuer::from_ca_cert_pem(&text, key)
            .map_err(|e| KeyError::Unreadable { path: pem, what: e.to_string() })
    }

    fn revoked_serials(&self) -> Result<Vec<Vec<u8>>, KeyError> {
        let path = self.revoked_file();
        if !path.exists() {
            return Ok(Vec::new());
        }
        let der = read_pem_block(&path)?;
        serials_of_list(&der)
            .ok_or_else(|| KeyError::Unreadable { path, what: "not a certificate revocation list".into() })
    }

    fn write_revoked(&self, serials: &[Vec<u8>], now: UtcTime) -> Result<(), KeyError> {
        let list = CertificateRevocationListParams {
            this_update: day(now)?,
            next_update: day(plus_days(now, 3_650))?,
            crl_number: SerialNumber::from(now.unix_ns().max(0) as u64 / NS_PER_S as u64),
            issuing_distribution_point: None,
            revoked_certs: serials
                .iter()
                .map(|serial| {
                    Ok(RevokedCertParams {
                        serial_number: SerialNumber::from_slice(serial),
                        revocation_time: day(now)?,
                        reason_code: Some(RevocationReason::KeyCompromise),
                        invalidity_date: None,
                    })
                })
                .collect::<Result<_, KeyError>>()?,
            key_identifier_method: KeyIdMethod::Sha256,
        };
        let signed = list.signed_by(&self.issuer()?).map_err(crypto)?;
        write_file(&self.revoked_file(), signed.pem().map_err(crypto)?.as_bytes(), 0o644)
    }
}

fn check_name(name: &str) -> Result<(), KeyError> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-';
    let fits = (1..=40).contains(&name.len()) && name.chars().all(allowed);
    if fits && !name.starts_with('-') && !name.ends_with('-') {
        return Ok(());
    }
    Err(KeyError::Name(name.to_owned()))
}

fn plus_days(now: UtcTime, days: i64) -> UtcTime {
    UtcTime::from_unix_ns(now.unix_ns().saturating_add(days.saturating_mul(86_400 * NS_PER_S)))
}

/// The start of a day in the certificate library's type. Before 2020 the clock was never set.
fn day(at: UtcTime) -> Result<::time::OffsetDateTime, KeyError> {
    let Civil { year, month, day, .. } = at.civil();
    if year < 2020 {
        return Err(KeyError::ClockNotSet(at.to_string()));
    }
    Ok(rcgen::date_time_ymd(year, month, day))
}

/// Common parameters of all certificates: valid from 1970 on, because a payload without a battery-backed clock starts
/// there and must be able to use its link before it knows the time.
fn params(name: &str, days: i64, now: UtcTime) -> Result<CertificateParams, KeyError> {
    let mut params = CertificateParams::default();
    params.not_before = rcgen::date_time_ymd(1970, 1, 1);
    day(now)?;
    params.not_after = day(plus_days(now, days))?;
    let mut serial = [0_u8; 16];
    ring::rand::SystemRandom::new().fill(&mut serial).map_err(crypto)?;
    serial[0] = (serial[0] & 0x7f) | 0x40;
    params.serial_number = Some(SerialNumber::from_slice(&serial));
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    params.distinguished_name.push(DnType::OrganizationName, DOMAIN);
    Ok(params)
}

fn write_key(path: &Path, key: &KeyPair) -> Result<(), KeyError> {
    write_file(path, key.serialize_pem().as_bytes(), 0o600)
}

/// Writes a temporary file and renames it, so that a reader never sees part of it.
fn write_file(path: &Path, bytes: &[u8], mode: u32) -> Result<(), KeyError> {
    let failed = |source| KeyError::File { action: "write", path: path.to_owned(), source };
    let beside = path.with_extension("new");
    let write = || -> std::io::Result<()> {
        // The temporary file of an interrupted run may have another mode.
        let _ = std::fs::remove_file(&beside);
        let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(mode).open(&beside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    };
    write().map_err(failed)
}

fn read(path: &Path) -> Result<String, KeyError> {
    std::fs::read_to_string(path).map_err(|source| KeyError::File {
        action: "read",
        path: path.to_owned(),
        source,
    })
}

/// Reads a private key (PEM); refuses a file that others than its owner may read.
pub fn read_private(path: &Path) -> Result<String, KeyError> {
    let failed = |source| KeyError::File { action: "read", path: path.to_owned(), source };
    let mode = std::fs::metadata(path).map_err(failed)?.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        return Err(KeyError::Loose { path: path.to_owned(), mode });
    }
    read(path)
}

fn read_pem_block(path: &Path) -> Result<Vec<u8>, KeyError> {
    let text = read(path)?;
    let (_, block) = x509_parser::pem::parse_x509_pem(text.as_bytes())
        .map_err(|e| KeyError::Unreadable { path: path.to_owned(), what: e.to_string() })?;
    Ok(block.contents)
}

fn read_der(path: &Path) -> Result<Vec<u8>, KeyError> {
    let der = read_pem_block(path)?;
    match x509_parser::parse_x509_certificate(&der) {
        Ok(_) => Ok(der),
        Err(e) => Err(KeyError::Unreadable { path: path.to_owned(), what: e.to_string() }),
    }
}

/// Role and name in a certificate's alternative names; `None` where it is not of such an authority.
pub fn peer_of(certificate_der: &[u8]) -> Option<(Role, String)> {
    let (_, certificate) = x509_parser::parse_x509_certificate(certificate_der).ok()?;
    let names = certificate.subject_alternative_name().ok()??;
    names.value.general_names.iter().find_map(|name| {
        let x509_parser::extensions::GeneralName::DNSName(dns) = name else { return None };
        [Role::Payload, Role::Station].into_iter().find_map(|role| {
            let name = dns.strip_suffix(&role.server_name())?.strip_suffix('.')?;
            (!name.is_empty()).then(|| (role, name.to_owned()))
        })
    })
}

/// Serial number of a certificate, big-endian without leading zeros.
pub fn serial_of(certificate_der: &[u8]) -> Option<Vec<u8>> {
    let (_, certificate) = x509_parser::parse_x509_certificate(certificate_der).ok()?;
    Some(certificate.tbs_certificate.serial.to_bytes_be())
}

/// Last instant at which a certificate is valid.
pub fn expiry_of(certificate_der: &[u8]) -> Option<UtcTime> {
    let (_, certificate) = x509_parser::parse_x509_certificate(certificate_der).ok()?;
    Some(UtcTime::from_unix_ns(certificate.validity().not_after.timestamp().saturating_mul(NS_PER_S)))
}

/// Serial numbers on a revocation list.
pub fn serials_of_list(list_der: &[u8]) -> Option<Vec<Vec<u8>>> {
    use x509_parser::prelude::FromDer as _;
    let (_, list) = x509_parser::revocation_list::CertificateRevocationList::from_der(list_der).ok()?;
    Some(list.iter_revoked_certificates().map(|entry| entry.serial().to_bytes_be()).collect())
}

#[cfg(test)]
#[path = "keys_tests.rs"]
mod tests;
