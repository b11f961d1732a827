//! The connection to a broker: TCP, or TLS over it.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use rustls::sign::CertifiedKey;
use rustls::{CertificateError, ClientConfig, ClientConnection, Error, RootCertStore, StreamOwned};

use super::address::Address;
use super::certificate::Identity;

/// What is waited for an answer.
pub(super) const ANSWER: Duration = Duration::from_secs(10);

/// Why a connection ended.
#[derive(Debug)]
pub(super) enum Ended {
    /// The broker cannot be reached any more.
    Lost(String),
    /// The broker does not want it, or is not to be trusted: why, and the help.
    Refused(String, &'static str),
    /// Nobody takes messages any more.
    Over,
}

use Ended::{Lost, Refused};

/// A connection is lost by this error.
pub(super) fn lost(error: &io::Error) -> Ended {
    Lost(format!("the connection is lost: {error}"))
}

/// Nothing has come for too long.
pub(super) fn no_answer() -> Ended {
    Lost(format!("no answer in {} s", ANSWER.as_secs()))
}

/// Bytes from and to a broker.
pub(super) enum Stream {
    Plain(TcpStream),
    Secure(Box<Secure>),
}

/// The same by TLS.
pub(super) struct Secure {
    tls: StreamOwned<ClientConnection, TcpStream>,
    identity: Arc<Identity>,
}

impl Stream {
    /// To the first address of the host that takes a connection; with the certificate of this client, if it has one.
    pub(super) fn open(address: &Address, certificate: Option<&Arc<CertifiedKey>>) -> Result<Stream, Ended> {
        let socket = connected(address)?;
        match address.secure {
            false => Ok(Stream::Plain(socket)),
            true => secured(address, socket, Identity::new(certificate.cloned())),
        }
    }

    /// The broker has let this client in.
    pub(super) fn accepted(&self) {
        if let Stream::Secure(secure) = self {
            secure.identity.accepted();
        }
    }

    /// Why it has ended by this error.
    pub(super) fn lost(&self, error: &io::Error) -> Ended {
        self.refused(error).unwrap_or_else(|| lost(error))
    }

    /// Why the broker has closed it.
    pub(super) fn closed(&self) -> Ended {
        let refused = self.refused(&ErrorKind::UnexpectedEof.into());
        refused.unwrap_or_else(|| Lost("the broker has closed the connection".to_owned()))
    }

    fn refused(&self, error: &io::Error) -> Option<Ended> {
        match self {
            Stream::Plain(_) => None,
            Stream::Secure(secure) => secure.identity.refused(error),
        }
    }

    /// Sends all of these bytes.
    pub(super) fn send(&mut self, bytes: &[u8]) -> Result<(), Ended> {
        let Err(error) = self.write_all(bytes).and_then(|()| self.flush()) else { return Ok(()) };
        // A broker that has closed it may have said why before.
        let said = match self.read(&mut [0; 1]) {
            Err(said) if said.kind() == ErrorKind::InvalidData => said,
            _ => error,
        };
        Err(self.lost(&said))
    }

    /// How long a read waits.
    pub(super) fn wait_at_most(&self, wait: Duration) -> io::Result<()> {
        match self {
            Stream::Plain(socket) => socket.set_read_timeout(Some(wait)),
            Stream::Secure(secure) => secure.tls.sock.set_read_timeout(Some(wait)),
        }
    }
}

impl Read for Stream {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Stream::Plain(socket) => socket.read(buffer),
            Stream::Secure(secure) => secure.tls.read(buffer),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Stream::Plain(socket) => socket.write(bytes),
            Stream::Secure(secure) => secure.tls.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Stream::Plain(socket) => socket.flush(),
            Stream::Secure(secure) => secure.tls.flush(),
        }
    }
}

fn connected(address: &Address) -> Result<TcpStream, Ended> {
    let found = (address.host.as_str(), address.port).to_socket_addrs();
    let found = found.map_err(|e| Lost(format!("the host is not known: {e}")))?;
    let mut refused = Lost("the host has no address".to_owned());
    for place in found {
        match TcpStream::connect_timeout(&place, ANSWER) {
            Ok(socket) => {
                socket
                    .set_write_timeout(Some(ANSWER))
                    .and_then(|()| socket.set_read_timeout(Some(ANSWER)))
                    .and_then(|()| socket.set_nodelay(true))
                    .map_err(|e| lost(&e))?;
                return Ok(socket);
            }
            Err(e) => refused = Lost(format!("no connection: {e}")),
        }
    }
    Err(refused)
}

/// TLS 1.2 or 1.3 over a connection, where the broker's certificate is that of its host, signed by an authority that this
/// machine trusts: those of the system, or of the file that `SSL_CERT_FILE` names.
fn secured(address: &Address, socket: TcpStream, identity: Identity) -> Result<Stream, Ended> {
    let found = rustls_native_certs::load_native_certs();
    let mut trusted = RootCertStore::empty();
    trusted.add_parsable_certificates(found.certs);
    if trusted.is_empty() {
        let why = found.errors.first().map_or_else(String::new, |e| format!(" ({e})"));
        return Err(Refused(
            format!("this machine has no certificates of authorities to trust{why}"),
            "name a file of them (PEM) in the environment variable SSL_CERT_FILE, or install them (Debian: ca-certificates)",
        ));
    }
    let failed = |e: Error| Lost(format!("no TLS: {e}"));
    let identity = Arc::new(identity);
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(failed)?
        .with_root_certificates(trusted)
        .with_client_cert_resolver(Arc::clone(&identity) as Arc<_>);
    let name = ServerName::try_from(address.host.clone())
        .map_err(|_| Lost(format!("`{}` is no name that a certificate could have", address.host)))?;
    let connection = ClientConnection::new(Arc::new(config), name).map_err(failed)?;
    let mut tls = StreamOwned::new(connection, socket);
    while tls.conn.is_handshaking() {
        let shaken = tls.conn.complete_io(&mut tls.sock);
        shaken.map_err(|e| identity.refused(&e).unwrap_or_else(|| untrusted(&e)))?;
    }
    Ok(Stream::Secure(Box::new(Secure { tls, identity })))
}

/// Why TLS could not begin.
fn untrusted(error: &io::Error) -> Ended {
    use CertificateError::{Expired, ExpiredContext, NotValidForName, NotValidForNameContext, UnknownIssuer};
    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) {
        return no_answer();
    }
    let Some(Error::InvalidCertificate(why)) = error.get_ref().and_then(|e| e.downcast_ref::<Error>()) else {
        return Lost(format!("no TLS: {error}"));
    };
    match why {
        UnknownIssuer => Refused(
            "its certificate is signed by nobody whom this machine trusts".to_owned(),
            "name the file (PEM) of the authority that signed it in the environment variable SSL_CERT_FILE",
        ),
        NotValidForName | NotValidForNameContext { .. } => Refused(
            "its certificate is that of another host".to_owned(),
            "name the broker's host as its certificate does",
        ),
        Expired | ExpiredContext { .. } => Refused(
            "its certificate has expired".to_owned(),
            "renew it, and see that the clock of this machine is right",
        ),
        _ => Refused(format!("its certificate is refused: {why}"), "let the broker have another one"),
    }
}
