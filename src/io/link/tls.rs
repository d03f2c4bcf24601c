//! Mutual authentication: TLS 1.3 with certificates of one authority on both sides.

use std::path::PathBuf;
use std::sync::Arc;

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use rustls::RootCertStore;
use rustls::client::WebPkiServerVerifier;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;

use super::keys::{KeyError, Role, expiry_of, peer_of, read_private, serial_of, serials_of_list};
use windhover_base::time::UtcTime;

/// Protocol name in the TLS handshake; the number is the major version of the message format.
const ALPN: &[u8] = b"windhover/1";

/// The key files of one side of the link.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct KeyFiles {
    /// Certificate of the authority.
    pub authority: PathBuf,
    /// Own certificate.
    pub certificate: PathBuf,
    /// Own private key.
    pub key: PathBuf,
    /// Revocation list.
    pub revoked: Option<PathBuf>,
}

/// One side's certificate and key, and the authority that it trusts.
pub struct Identity {
    /// Payload or station.
    pub role: Role,
    /// Its name.
    pub name: String,
    /// Last instant at which its certificate is valid.
    pub expires: UtcTime,
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    roots: Arc<RootCertStore>,
    lists: Vec<CertificateRevocationListDer<'static>>,
}

fn unreadable(path: &std::path::Path, what: impl std::fmt::Display) -> KeyError {
    KeyError::Unreadable { path: path.to_owned(), what: what.to_string() }
}

impl Identity {
    /// Reads the files; `role` is the required role of this side's certificate.
    pub fn load(files: &KeyFiles, role: Role) -> Result<Self, KeyError> {
        let mut roots = RootCertStore::empty();
        let authority =
            CertificateDer::from_pem_file(&files.authority).map_err(|e| unreadable(&files.authority, e))?;
        roots.add(authority).map_err(|e| unreadable(&files.authority, e))?;
        let certificate = CertificateDer::from_pem_file(&files.certificate)
            .map_err(|e| unreadable(&files.certificate, e))?;
        let name = match peer_of(&certificate) {
            Some((found, name)) if found == role => name,
            Some((found, _)) => {
                let what = format!("this is the certificate of a {}, not of a {}", found.name(), role.name());
                return Err(unreadable(&files.certificate, what));
            }
            None => {
                return Err(unreadable(&files.certificate, "it has no role; make it with `windhover keys`"));
            }
        };
        let expires = expiry_of(&certificate).unwrap_or_default();
        let key = PrivateKeyDer::from_pem_slice(read_private(&files.key)?.as_bytes())
            .map_err(|e| unreadable(&files.key, e))?;
        let lists = match &files.revoked {
            Some(path) => {
                let list =
                    CertificateRevocationListDer::from_pem_file(path).map_err(|e| unreadable(path, e))?;
                vec![list]
            }
            None => Vec::new(),
        };
        Ok(Self { role, name, expires, chain: vec![certificate], key, roots: Arc::new(roots), lists })
    }

    /// Settings for accepting connections: only holders of a valid certificate are admitted.
    pub fn server(&self) -> Result<QuicServerConfig, KeyError> {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::clone(&self.roots), provider.clone())
            .with_crls(self.lists.iter().cloned())
            .build()
            .map_err(|e| KeyError::Crypto(e.to_string()))?;
        let mut config = rustls::ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(|e| KeyError::Crypto(e.to_string()))?
            .with_client_cert_verifier(verifier)
            .with_single_cert(self.chain.clone(), self.key.clone_key())
            .map_err(|e| KeyError::Crypto(e.to_string()))?;
        config.alpn_protocols = vec![ALPN.to_vec()];
        // A resumed session would not be checked against a newer revocation list.
        config.session_storage = Arc::new(rustls::server::NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        QuicServerConfig::try_from(config).map_err(|e| KeyError::Crypto(e.to_string()))
    }

    /// Settings for opening connections: only a peer with a valid certificate of the other role is accepted.
    pub fn client(&self) -> Result<QuicClientConfig, KeyError> {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = WebPkiServerVerifier::builder_with_provider(Arc::clone(&self.roots), provider.clone())
            .with_crls(self.lists.iter().cloned())
            .build()
            .map_err(|e| KeyError::Crypto(e.to_string()))?;
        let mut config = rustls::ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(|e| KeyError::Crypto(e.to_string()))?
            .with_webpki_verifier(verifier)
            .with_client_auth_cert(self.chain.clone(), self.key.clone_key())
            .map_err(|e| KeyError::Crypto(e.to_string()))?;
        config.alpn_protocols = vec![ALPN.to_vec()];
        config.resumption = rustls::client::Resumption::disabled();
        QuicClientConfig::try_from(config).map_err(|e| KeyError::Crypto(e.to_string()))
    }

    /// The key for this side's stateless resets. It depends on the private key only, so that after a restart the peers
    /// of the old process learn at once that it is gone.
    pub fn reset_key(&self) -> ring::hmac::Key {
        let secret = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, self.key.secret_der());
        let derived = ring::hmac::sign(&secret, b"windhover stateless reset");
        ring::hmac::Key::new(ring::hmac::HMAC_SHA256, derived.as_ref())
    }

    /// Whether a certificate is on the revocation list.
    pub fn is_revoked(&self, certificate: &[u8]) -> bool {
        let Some(serial) = serial_of(certificate) else { return true };
        self.lists.iter().any(|list| serials_of_list(list).is_none_or(|serials| serials.contains(&serial)))
    }
}

/// The certificate of the other side of a connection.
pub fn peer_certificate(connection: &quinn::Connection) -> Option<CertificateDer<'static>> {
    let chain = connection.peer_identity()?.downcast::<Vec<CertificateDer<'static>>>().ok()?;
    chain.into_iter().next()
}

/// The reason why a connection failed, as text, and whether a certificate was the reason.
pub fn refusal(error: &quinn::ConnectionError) -> (String, bool) {
    use quinn::ConnectionError as E;
    let code = match error {
        E::TransportError(e) => u64::from(e.code),
        E::ConnectionClosed(close) => u64::from(close.error_code),
        _ => return (error.to_string(), false),
    };
    // A TLS alert n travels as QUIC error 0x100 + n (RFC 9001, 4.8; alerts: RFC 8446, 6).
    let by_peer = matches!(error, E::ConnectionClosed(_));
    let what = match code.checked_sub(0x100) {
        Some(42 | 43 | 46) => "certificate not accepted",
        Some(44) => "certificate revoked",
        Some(45) => "certificate expired",
        Some(48) => "certificate of another authority",
        Some(51) => "certificate's signature is wrong",
        Some(116) => "no certificate",
        Some(120) => "another version of the link",
        Some(0..=255) => "TLS handshake failed",
        _ => return (error.to_string(), false),
    };
    let side = if by_peer { "the other side refused us" } else { "refused" };
    (format!("{side}: {what} ({error})"), true)
}
