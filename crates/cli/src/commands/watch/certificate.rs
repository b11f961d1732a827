//! The certificate of this client and its key, for a broker that demands one.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustls::client::ResolvesClientCert;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::{CertifiedKey, SigningKey};
use rustls::{AlertDescription, Error, SignatureScheme};

use super::connection::Ended;
use crate::failure::Failure;
use crate::loading;

/// What OpenSSL writes into the file of an encrypted key: of PKCS#8, and of older formats.
const ENCRYPTED: [&str; 2] = ["BEGIN ENCRYPTED PRIVATE KEY", "Proc-Type: 4,ENCRYPTED"];

/// Reads a certificate, with those after it that lead to its authority, and its key, which may stand in the same file.
///
/// # Errors
/// Bad input: a file that cannot be read, without a certificate or a key, or whose key is encrypted, of a kind that TLS does not
/// take here, or another certificate's.
pub(super) fn read(certificate: &Path, key: Option<&Path>) -> Result<Arc<CertifiedKey>, Failure> {
    let text = pem(certificate)?;
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(text.as_bytes()).collect();
    let chain = chain.map_err(|_| damaged(certificate))?;
    if chain.is_empty() {
        return Err(Failure::file(certificate, "there is no certificate in this file")
            .help("name a PEM file after `--cert`, with `-----BEGIN CERTIFICATE-----`"));
    }
    let (place, text) = match key {
        None => (certificate, text),
        Some(key) => (key, pem(key)?),
    };
    let key = match PrivateKeyDer::from_pem_slice(text.as_bytes()) {
        Ok(key) => key,
        Err(rustls::pki_types::pem::Error::NoItemsFound) => {
            return Err(Failure::file(place, "there is no private key in this file")
                .help("name the key's PEM file after `--key`, with `-----BEGIN PRIVATE KEY-----`"));
        }
        Err(_) => return Err(damaged(place)),
    };
    let provider = rustls::crypto::ring::default_provider();
    let key = provider.key_provider.load_private_key(key).map_err(|_| {
        Failure::file(place, "the key is of no kind that is taken here")
            .help("have one made of RSA (2048 to 4096 bits), ECDSA (P-256 or P-384) or Ed25519")
    })?;
    if !chain.first().is_some_and(|own| is_of(own, &*key)) {
        let certificate = certificate.display();
        return Err(Failure::file(place, format!("the key is not that of the certificate in {certificate}")).help(
            "name the key with which the certificate was requested; the client's own certificate comes first in its file",
        ));
    }
    Ok(Arc::new(CertifiedKey::new(chain, key)))
}

/// Whether a certificate is that of a key: it has the public half in it as it stands. (rustls compares the two in certificates of
/// version 3 alone; `openssl x509 -req` makes those of version 1 where no extensions are asked for, and brokers take them.)
fn is_of(certificate: &CertificateDer<'_>, key: &dyn SigningKey) -> bool {
    key.public_key()
        .is_none_or(|public| certificate.windows(public.len()).any(|part| part == public.as_ref()))
}

/// The text of a PEM file without an encrypted key.
fn pem(path: &Path) -> Result<String, Failure> {
    let text = loading::text(path).map_err(|failure| match is_der(path) {
        true => Failure::file(path, "this is DER, not PEM").help(
            "convert it: `openssl x509 -inform der -in client.der -out client.pem`, a key by `openssl pkey` in place of \
             `openssl x509`",
        ),
        false => failure,
    })?;
    match ENCRYPTED.iter().any(|mark| text.contains(mark)) {
        true => Err(Failure::file(path, "the key in this file is encrypted").help(
            "decrypt it into a file that only you may read: `openssl pkey -in client.key -out plain.key`",
        )),
        false => Ok(text),
    }
}

/// Whether a file begins as certificates and keys in binary do.
fn is_der(path: &Path) -> bool {
    // (A pipe cannot be read a second time.)
    path.is_file() && fs::read(path).is_ok_and(|bytes| bytes.first() == Some(&0x30))
}

// (What is wrong in detail is not said: the text may be a key.)
fn damaged(path: &Path) -> Failure {
    Failure::file(path, "the certificate or key in this file is damaged")
        .help("copy the file again, or have it made again")
}

/// What this client shows who it is by, and whether the broker has asked for it.
#[derive(Debug)]
pub(super) struct Identity {
    certificate: Option<Arc<CertifiedKey>>,
    asked: AtomicBool,
}

impl Identity {
    pub(super) fn new(certificate: Option<Arc<CertifiedKey>>) -> Identity {
        Identity { certificate, asked: AtomicBool::new(false) }
    }

    /// The broker has let this client in: what ends the connection from now on is something else.
    pub(super) fn accepted(&self) {
        self.asked.store(false, Ordering::Relaxed);
    }

    /// Why the broker has refused this client, where it has done so by ending the connection with this error.
    pub(super) fn refused(&self, error: &io::Error) -> Option<Ended> {
        use AlertDescription::{CertificateExpired, UnknownCA};
        if !self.asked.load(Ordering::Relaxed) {
            return None;
        }
        let alert = match error.get_ref().and_then(|e| e.downcast_ref::<Error>()) {
            Some(Error::AlertReceived(alert)) => Some(alert),
            Some(_) => return None,
            None => None,
        };
        let closed = [
            ErrorKind::UnexpectedEof,
            ErrorKind::ConnectionReset,
            ErrorKind::ConnectionAborted,
            ErrorKind::BrokenPipe,
        ];
        let (message, help) = match (&self.certificate, alert) {
            (None, None) if !closed.contains(&error.kind()) => return None,
            (None, _) => (
                "the broker demands a certificate of its client".to_owned(),
                "name the PEM files that the broker's operator gave you: `--cert client.pem --key client.key`",
            ),
            (Some(_), None) => return None,
            (Some(_), Some(UnknownCA)) => (
                "the broker does not trust the authority that signed this client's certificate".to_owned(),
                "name a certificate of an authority that the broker trusts (mosquitto: `cafile`) after `--cert`, with those \
                 between the two after it in the file",
            ),
            (Some(_), Some(CertificateExpired)) => (
                "this client's certificate has expired".to_owned(),
                "renew it, and see that the clocks of both machines are right",
            ),
            (Some(_), Some(alert)) => (
                format!("the broker refuses this client's certificate ({alert:?})"),
                "ask the broker's operator for a certificate of a client, and name it after `--cert`",
            ),
        };
        Some(Ended::Refused(message, help))
    }
}

impl ResolvesClientCert for Identity {
    fn resolve(&self, _authorities: &[&[u8]], _schemes: &[SignatureScheme]) -> Option<Arc<CertifiedKey>> {
        self.asked.store(true, Ordering::Relaxed);
        self.certificate.clone()
    }

    fn has_certs(&self) -> bool {
        self.certificate.is_some()
    }
}
