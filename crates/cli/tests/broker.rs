//! `greybox watch --from mqtt://…` at a real broker.
#![cfg(feature = "mqtt")]
#![allow(missing_docs, clippy::unwrap_used)]

use std::fmt::Write as _;
use std::process::Stdio;

use common::Bench;
use running::{Broker, Running, Watching, until, watch};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;
#[path = "common/running.rs"]
mod running;
#[allow(dead_code, reason = "not every test file uses all of it")]
#[path = "common/throttle.rs"]
mod throttle;

fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("throttle.toml", throttle::MODEL);
    bench
}

/// So many seconds of samples, an object each.
fn messages(seconds: f64) -> Vec<String> {
    let samples = throttle::samples(seconds);
    let message = |[t, torque, angle]: &[f64; 3]| {
        format!(r#"{{"t": {t}, "torque": {torque:.5}, "angle": {angle:.6}}}"#)
    };
    samples.iter().map(message).collect()
}

/// What the same samples on standard input leave: the lines, and the state.
fn fed(bench: &Bench, text: &str) -> (Vec<String>, String) {
    let arguments = ["watch", "throttle.toml", "--json", "--learn", "15", "--state", "fed.json"];
    let said = bench.greybox_fed(&arguments, text);
    assert_eq!(said.code, 0, "{}", said.stderr);
    let state = bench.read("fed.json");
    std::fs::remove_file(bench.path("fed.json")).unwrap();
    (said.stdout.lines().map(str::to_owned).collect(), state)
}

/// The broker is killed and comes back: nothing is lost of what it had, and nothing that it has kept from before counts.
#[test]
fn a_broker_that_is_killed_is_waited_for() {
    let bench = bench();
    let Some(mut broker) = Broker::start(&bench, "allow_anonymous true") else { return };
    let lines = messages(30.0);
    let (first, second) = lines.split_at(2000);
    let (early, early_state) = fed(&bench, &first.join("\n"));
    let (whole, whole_state) = fed(&bench, &lines.join("\n"));
    let retained = [r#"{"t": 1e6, "torque": 0, "angle": 0}"#.to_owned()];
    broker.publish(&retained, &["-r"]);

    let from = format!("mqtt://127.0.0.1:{}/plant/+", broker.port);
    let watching = Watching::start(&bench, &["--learn", "15", "--from", &from, "--state", "state.json"]);
    assert_eq!(watching.until("subscribed").len(), 1);
    broker.publish(first, &[]);
    // The machine is silent now: the state is saved all the same.
    watching.until_saved(&bench, "state.json", &early_state);
    let mut said = watching.rest();
    assert_eq!(said, early);

    broker.kill();
    let (_, lost) = watching.next();
    assert_eq!((&lost["event"], &lost["pause"]), (&"disconnected".into(), &1.into()), "{lost}");
    assert!(broker.run());
    broker.publish(&retained, &["-r"]);
    while watching.next().1["event"] != "subscribed" {}
    broker.publish(second, &[]);
    watching.until_saved(&bench, "state.json", &whole_state);
    said.extend(watching.rest());
    assert_eq!(said, whole);
}

/// Lines of the Influx protocol, many in a message, from a broker that asks who is there.
#[test]
fn a_broker_with_users_sends_lines_of_the_influx_protocol() {
    let bench = bench();
    let passwords = bench.path("passwords");
    let config = format!("allow_anonymous false\npassword_file {}", passwords.display());
    // (Made by `mosquitto_passwd`: user `rig`, password `a:b@c`.)
    bench.write("passwords", "");
    let made = std::process::Command::new("mosquitto_passwd")
        .args(["-b", passwords.to_str().unwrap(), "rig", "a:b@c"])
        .stderr(Stdio::null())
        .status();
    if !made.is_ok_and(|status| status.success()) {
        eprintln!("skipped: mosquitto_passwd is not installed (Debian: mosquitto)");
        return;
    }
    let Some(broker) = Broker::start(&bench, &config) else { return };
    let mut text = String::new();
    let mut messages = Vec::new();
    for ten in throttle::samples(20.0).chunks(10) {
        let mut message = String::from("# by Telegraf\n");
        for [t, torque, angle] in ten {
            let ns = 1_795_955_696_123_456_789 + (t * 1e9).round() as i64;
            let _ = writeln!(message, "throttle,site=a torque={torque:.5},angle={angle:.6} {ns}");
        }
        text.push_str(&message);
        messages.push(message);
    }
    let (whole, state) = fed(&bench, &text);
    assert!(whole[0].contains(r#""t":"2026-11-29T12:35:11.123457Z"#), "{}", whole[0]);

    let from = format!("mqtt://rig:a%3Ab%40c@127.0.0.1:{}/plant/#", broker.port);
    let watching = Watching::start(&bench, &["--learn", "15", "--from", &from, "--state", "state.json"]);
    let subscribed = watching.until("subscribed");
    assert!(subscribed.len() == 1 && !subscribed[0].contains("a:b") && !subscribed[0].contains("rig"));
    let login = ["-u", "rig", "-P", "a:b@c"];
    for message in &messages {
        let status = broker.client("mosquitto_pub", &login).args(["-m", message]).status();
        assert!(status.unwrap().success());
    }
    // A value alone is no sample, and is said to be none.
    broker.publish(&["1.23".to_owned()], &login);
    watching.until_saved(&bench, "state.json", &state);
    let said = watching.until("unreadable");
    assert_eq!(said[..said.len() - 1], whole[..]);
    assert!(said.last().unwrap().contains("`1.23` is a value alone"), "{said:?}");

    for login in ["rig:wrong@", ""] {
        let from = format!("mqtt://{login}127.0.0.1:{}/plant/throttle", broker.port);
        let refused = bench.greybox_fed(&["watch", "throttle.toml", "--from", &from], "");
        assert_eq!((refused.code, refused.stdout.as_str()), (2, ""));
        assert!(refused.stderr.contains("the broker refuses the connection"), "{}", refused.stderr);
        assert!(
            refused.stderr.contains("--from mqtt://user:password@host") && !refused.stderr.contains("wrong")
        );
    }
}

/// Two authorities, and a broker's certificate of 127.0.0.1 that the first has signed; `false`, and a word of it, without `openssl`.
#[allow(clippy::print_stderr, reason = "what is skipped is said")]
fn certificates(bench: &Bench) -> bool {
    bench.write("names", "subjectAltName = IP:127.0.0.1\n");
    let new = "req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
    let made = [
        format!("{new} -x509 -days 2 -subj /CN=authority -keyout authority.key -out authority.pem"),
        format!("{new} -x509 -days 2 -subj /CN=other -keyout other.key -out other.pem"),
        format!("{new} -subj /CN=broker -keyout broker.key -out broker.csr"),
        "x509 -req -days 2 -in broker.csr -CA authority.pem -CAkey authority.key -CAcreateserial -extfile names \
         -out broker.pem"
            .to_owned(),
    ]
    .iter()
    .all(|arguments| openssl(bench, arguments));
    if !made {
        eprintln!("skipped: openssl is not installed (Debian: openssl)");
    }
    made
}

fn openssl(bench: &Bench, arguments: &str) -> bool {
    let mut openssl = std::process::Command::new("openssl");
    openssl.args(arguments.split_whitespace()).current_dir(bench.path(".")).stderr(Stdio::null());
    openssl.status().is_ok_and(|status| status.success())
}

/// Certificates of clients beside [`certificates`], with keys of every format.
fn client_certificates(bench: &Bench) {
    let signed = "x509 -req -days 2 -CA authority.pem -CAkey authority.key -CAcreateserial";
    for arguments in [
        "req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj /CN=rig -keyout client.key -out client.csr",
        &format!("{signed} -in client.csr -out client.pem"),
        "ec -in client.key -out sec1.key",
        "req -newkey rsa:2048 -nodes -subj /CN=rig -keyout rsa8.key -out rsa.csr",
        &format!("{signed} -in rsa.csr -out rsa.pem"),
        "rsa -in rsa8.key -traditional -out rsa.key",
        "pkey -in client.key -aes256 -passout pass:secret -out encrypted.key",
        "rsa -in rsa8.key -traditional -aes256 -passout pass:secret -out old.key",
        "x509 -req -days 2 -in client.csr -CA other.pem -CAkey other.key -CAcreateserial -out stranger.pem",
        "x509 -in client.pem -outform der -out client.der",
        &format!("{signed} -in client.csr -extfile names -out third.pem"),
        "req -newkey ec -pkeyopt ec_paramgen_curve:secp521r1 -nodes -x509 -subj /CN=rig -keyout p521.key -out p521.pem",
    ] {
        assert!(openssl(bench, arguments), "openssl {arguments}");
    }
    bench.write("both.pem", &(bench.read("client.pem") + &bench.read("sec1.key")));
    bench.write("damaged.key", &bench.read("client.key").replace("\nM", "\n?"));
    for (file, form) in [
        ("client.key", "BEGIN PRIVATE KEY"),
        ("sec1.key", "BEGIN EC PRIVATE KEY"),
        ("rsa.key", "BEGIN RSA PRIVATE KEY"),
    ] {
        assert!(bench.read(file).contains(form), "{file}");
    }
}

/// What comes by TLS is what was sent; a broker that the machine does not trust, or that is another, is refused.
#[test]
fn a_broker_by_tls_is_followed_where_its_certificate_is_trusted() {
    let bench = bench();
    if !certificates(&bench) {
        return;
    }
    let at = |file: &str| bench.path(file).display().to_string();
    let config = format!("allow_anonymous true\ncertfile {}\nkeyfile {}", at("broker.pem"), at("broker.key"));
    let Some(mut broker) = Broker::start(&bench, &config) else { return };
    let lines = messages(20.0);
    let (whole, state) = fed(&bench, &lines.join("\n"));
    let of = |trusted: &str, from: &str| {
        let mut command = watch(&bench);
        command.args(["--learn", "15", "--from", from]).env("SSL_CERT_FILE", at(trusted));
        command.env_remove("SSL_CERT_DIR");
        command
    };
    let from = |scheme: &str, host: &str, port: &str| format!("{scheme}://{host}:{port}/plant/throttle");

    let mut command = of("authority.pem", &from("mqtts", "127.0.0.1", &broker.port));
    let watching = Watching::start_as(command.args(["--state", "state.json"]));
    let subscribed = watching.until("subscribed");
    assert!(subscribed.len() == 1 && subscribed[0].contains("mqtts://127.0.0.1"), "{subscribed:?}");
    broker.publish(&lines, &["--cafile", &at("authority.pem")]);
    watching.until_saved(&bench, "state.json", &state);
    assert_eq!(watching.rest(), whole);
    broker.kill();
    assert_eq!(watching.next().1["event"], "disconnected");
    assert!(broker.run());
    while watching.next().1["event"] != "subscribed" {}

    bench.write("nobody.pem", "");
    // Two that are no brokers: one hangs up on whoever comes, one is silent.
    let [rude, silent] = [0, 1].map(|_| std::net::TcpListener::bind("127.0.0.1:0").unwrap());
    let [rude_port, silent_port] = [&rude, &silent].map(|l| l.local_addr().unwrap().port().to_string());
    std::thread::spawn(move || rude.incoming().for_each(drop));
    for (trusted, from, words) in [
        ("other.pem", from("mqtts", "127.0.0.1", &broker.port), "signed by nobody whom this machine trusts"),
        ("other.pem", from("mqtts", "127.0.0.1", &broker.port), "SSL_CERT_FILE"),
        ("nobody.pem", from("mqtts", "127.0.0.1", &broker.port), "no certificates of authorities to trust"),
        (
            "authority.pem",
            from("mqtts", "localhost", &broker.port),
            "its certificate is that of another host",
        ),
        ("authority.pem", from("mqtts", "127.0.0.1", &rude_port), "no TLS"),
        ("authority.pem", from("mqtts", "127.0.0.1", &silent_port), "no answer in 10 s"),
        ("authority.pem", from("mqtt", "127.0.0.1", &broker.port), "see that the broker runs there"),
    ] {
        let said = of(trusted, &from).stdin(Stdio::null()).output().unwrap();
        let stderr = String::from_utf8(said.stderr).unwrap();
        assert_eq!(said.status.code(), Some(2), "{from}: {stderr}");
        assert!(stderr.contains(words), "{from}: {stderr}");
    }
    drop(silent);
}

/// A broker that demands a certificate takes that of this client, its key in whatever format; every other is refused, here or there.
#[test]
fn a_broker_that_demands_a_certificate_gets_one() {
    let bench = bench();
    if !certificates(&bench) {
        return;
    }
    client_certificates(&bench);
    let at = |file: &str| bench.path(file).display().to_string();
    let config = format!(
        "allow_anonymous true\nrequire_certificate true\ncafile {}\ncertfile {}\nkeyfile {}",
        at("authority.pem"),
        at("broker.pem"),
        at("broker.key")
    );
    let Some(mut broker) = Broker::start(&bench, &config) else { return };
    let lines = messages(20.0);
    let (whole, state) = fed(&bench, &lines.join("\n"));
    let from = |port: &str| format!("mqtts://127.0.0.1:{port}/plant/throttle");
    let with = |arguments: &[&str]| {
        let mut command = watch(&bench);
        command.args(["--learn", "15"]).args(arguments).env("SSL_CERT_FILE", at("authority.pem"));
        command.env_remove("SSL_CERT_DIR");
        command
    };
    let here = from(&broker.port);
    for [certificate, key] in [
        ["client.pem", "client.key"],
        ["client.pem", "sec1.key"],
        ["third.pem", "client.key"],
        ["rsa.pem", "rsa8.key"],
        ["rsa.pem", "rsa.key"],
    ] {
        let mut command = with(&["--from", &here, "--cert", certificate, "--key", key]);
        assert_eq!(Watching::start_as(&mut command).until("subscribed").len(), 1, "{certificate} {key}");
    }

    let mut command = with(&["--from", &here, "--cert", "both.pem", "--state", "state.json"]);
    let watching = Watching::start_as(&mut command);
    watching.until("subscribed");
    let login = ["--cafile", &at("authority.pem"), "--cert", &at("client.pem"), "--key", &at("client.key")];
    broker.publish(&lines, &login);
    watching.until_saved(&bench, "state.json", &state);
    assert_eq!(watching.rest(), whole);
    broker.kill();
    assert_eq!(watching.next().1["event"], "disconnected");
    assert!(broker.run());
    while watching.next().1["event"] != "subscribed" {}

    // Another broker, which demands one by TLS 1.2.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port().to_string();
    let server = "s_server -quiet -tls1_2 -Verify 1 -verify_return_error -CAfile authority.pem -cert broker.pem -key broker.key";
    let mut older = std::process::Command::new("openssl");
    older.args(server.split_whitespace()).args(["-accept", &port]).current_dir(bench.path("."));
    let older = older.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let _older = Running(older);
    until("it listens", || std::net::TcpStream::connect(format!("127.0.0.1:{port}")).is_ok());
    let plain = here.replace("mqtts", "mqtt");
    let (here, older) = (here.as_str(), &from(&port));
    for (arguments, parts) in [
        (
            &["--from", here][..],
            ["demands a certificate of its client", "--cert client.pem --key client.key"],
        ),
        (&["--from", older], ["demands a certificate of its client", "--cert client.pem --key client.key"]),
        (
            &["--from", here, "--cert", "stranger.pem", "--key", "client.key"],
            ["does not trust the authority that signed this client's certificate", "mosquitto: `cafile`"],
        ),
        (&["--from", here, "--cert", "nowhere.pem"], ["nowhere.pem: no such file", "check the path"]),
        (&["--from", here, "--cert", "client.pem", "--key", "gone.key"], ["gone.key: no such file", "path"]),
        (&["--from", here, "--cert", "client.key"], ["client.key: there is no certificate", "--cert"]),
        (&["--from", here, "--cert", "client.pem"], ["client.pem: there is no private key", "after `--key`"]),
        (
            &["--from", here, "--cert", "client.pem", "--key", "rsa.key"],
            ["rsa.key: the key is not that of the certificate in client.pem", "was requested"],
        ),
        (
            &["--from", here, "--cert", "client.pem", "--key", "encrypted.key"],
            ["encrypted.key: the key in this file is encrypted", "openssl pkey"],
        ),
        (
            &["--from", here, "--cert", "rsa.pem", "--key", "old.key"],
            ["old.key: the key in this file is encrypted", "openssl pkey"],
        ),
        (&["--from", here, "--cert", "client.der"], ["client.der: this is DER, not PEM", "-inform der"]),
        (
            &["--from", here, "--cert", "client.pem", "--key", "damaged.key"],
            ["damaged.key: the certificate or key in this file is damaged", "copy the file again"],
        ),
        (
            &["--from", here, "--cert", "p521.pem", "--key", "p521.key"],
            ["p521.key: the key is of no kind that is taken here", "P-384"],
        ),
        (
            &["--from", &plain, "--cert", "both.pem"],
            ["mqtt://127.0.0.1:", "`--cert both.pem` is for TLS, and this address is without"],
        ),
        (&["--cert", "both.pem"], ["--from <URL>", "required"]),
        (&["--from", here, "--key", "client.key"], ["--cert <FILE>", "required"]),
    ] {
        let said = with(arguments).stdin(Stdio::null()).output().unwrap();
        let stderr = String::from_utf8(said.stderr).unwrap();
        assert_eq!(said.status.code(), Some(2), "{arguments:?}: {stderr}");
        assert!(parts.iter().all(|part| stderr.contains(part)), "{arguments:?}: {stderr}");
    }
}

/// Samples of several topics are one stream; what comes by two subscriptions is one sample.
#[test]
fn several_topics_of_a_broker_are_one_stream() {
    let bench = bench();
    let Some(broker) = Broker::start(&bench, "allow_anonymous true") else { return };
    let lines = messages(20.0);
    let (whole, state) = fed(&bench, &lines.join("\n"));
    let from = |topic: &str| format!("--from=mqtt://127.0.0.1:{}/{topic}", broker.port);
    let (first, second) = (from("hall/1/throttle"), from("yard/samples"));
    let watching = Watching::start(&bench, &["--learn", "15", &first, &second, "--state", "state.json"]);
    let overlapping = Watching::start(&bench, &["--learn", "15", &first, &from("hall/#"), &second]);
    for topic in ["hall/1/throttle", "yard/samples"] {
        assert_eq!(watching.next().1["topic"], topic);
    }
    (0..3).for_each(|_| assert_eq!(overlapping.next().1["event"], "subscribed"));
    for (k, piece) in lines.chunks(300).enumerate() {
        let topic = ["hall/1/throttle", "yard/samples"][k % 2];
        broker.publish_to(topic, piece, &[]);
        broker.publish_to("elsewhere", piece, &[]);
    }
    watching.until_saved(&bench, "state.json", &state);
    assert_eq!(watching.rest(), whole);
    let mut said = Vec::new();
    while said.len() < whole.len() {
        let (line, event) = overlapping.next();
        if event["event"] == "irregular" {
            assert!(event["repeated"].as_u64() > Some(0) && event["late"] == 0, "{line}");
        } else {
            said.push(line);
        }
    }
    assert_eq!(said, whole);

    let refused = bench.greybox_fed(&["watch", "throttle.toml", &first, "--from=mqtt://other/yard"], "");
    assert_eq!(refused.code, 2);
    for part in ["`--from` names two brokers, mqtt://127.0.0.1:", "and mqtt://other:1883", "one broker"] {
        assert!(refused.stderr.contains(part), "{}", refused.stderr);
    }
}

/// A broker that refuses one topic of two: the subscription is refused, and the topic named.
#[test]
fn a_topic_that_is_refused_is_named() {
    use std::io::{Read as _, Write as _};
    let bench = bench();
    for (codes, named) in [(&[1, 0x80][..], "`yard`"), (&[0x80, 0x80], "`hall`, `yard`"), (&[1], "`yard`")] {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let broker = std::thread::spawn(move || {
            let mut socket = listener.accept().unwrap().0;
            let mut packet = [0; 256];
            assert!(socket.read(&mut packet).unwrap() > 0);
            socket.write_all(&[0x20, 2, 0, 0]).unwrap();
            let read = socket.read(&mut packet).unwrap();
            // (Its number, then each topic with its length before it and a byte of options after it.)
            assert_eq!(&packet[4..read], b"\0\x04hall\x01\0\x04yard\x01");
            let answer = [&[0x90, 2 + codes.len() as u8, packet[2], packet[3]], codes].concat();
            socket.write_all(&answer).unwrap();
            let _ = socket.read(&mut packet);
        });
        let from = |topic: &str| format!("--from=mqtt://127.0.0.1:{port}/{topic}");
        let said = bench.greybox_fed(&["watch", "throttle.toml", &from("hall"), &from("yard")], "");
        broker.join().unwrap();
        assert_eq!(said.code, 2);
        let part = format!("the broker refuses the subscription to {named}\n");
        assert!(said.stderr.contains(&part), "{}", said.stderr);
    }
}

#[test]
fn no_broker_at_the_beginning_is_an_error() {
    let bench = bench();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let from = format!("mqtt://127.0.0.1:{port}/plant");
    let said = bench.greybox_fed(&["watch", "throttle.toml", "--from", &from], "");
    assert_eq!(said.code, 2);
    assert!(
        said.stderr.contains("no connection") && said.stderr.contains("see that the broker runs"),
        "{}",
        said.stderr
    );
}
