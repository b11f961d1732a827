//! Processes that run beside a test: a broker, and a watch whose lines are read as they come.
#![allow(
    dead_code,
    clippy::print_stderr,
    reason = "not every test file uses all of it; what is skipped is said"
)]

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpListener;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::Duration;

use serde_json::Value;

use crate::common::Bench;

/// Most that anything is waited for.
const PATIENCE: Duration = Duration::from_secs(120);
const STEP: Duration = Duration::from_millis(50);

/// A process that ends with the test.
pub(crate) struct Running(pub(crate) Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits for something.
pub(crate) fn until(what: &str, mut holds: impl FnMut() -> bool) {
    for _ in 0..PATIENCE.as_millis() / STEP.as_millis() {
        if holds() {
            return;
        }
        thread::sleep(STEP);
    }
    panic!("waited in vain: {what}");
}

/// A mosquitto, where it is installed.
pub(crate) struct Broker {
    pub(crate) port: String,
    config: std::path::PathBuf,
    running: Option<Running>,
}

impl Broker {
    /// Starts one with these lines in its configuration; `None`, and a word of it, where there is none.
    pub(crate) fn start(bench: &Bench, config: &str) -> Option<Broker> {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        // (No limit to what waits: these publishers are faster than any plant.)
        bench.write(
            "broker.conf",
            &format!("listener {port} 127.0.0.1\nuser root\nmax_queued_messages 0\n{config}\n"),
        );
        let mut broker = Broker { port: port.to_string(), config: bench.path("broker.conf"), running: None };
        if !broker.run() {
            eprintln!("skipped: mosquitto is not installed (Debian: mosquitto, mosquitto-clients)");
            return None;
        }
        Some(broker)
    }

    /// Starts it, and waits until it listens.
    pub(crate) fn run(&mut self) -> bool {
        // (Debian has it where only an administrator's PATH looks.)
        let spawned = ["mosquitto", "/usr/sbin/mosquitto"].iter().find_map(|program| {
            Command::new(program).arg("-c").arg(&self.config).stderr(Stdio::null()).spawn().ok()
        });
        let Some(child) = spawned else { return false };
        self.running = Some(Running(child));
        until("the broker listens", || {
            std::net::TcpStream::connect(format!("127.0.0.1:{}", self.port)).is_ok()
        });
        true
    }

    pub(crate) fn kill(&mut self) {
        self.running = None;
    }

    pub(crate) fn client(&self, program: &str, more: &[&str]) -> Command {
        self.client_of(program, "plant/throttle", more)
    }

    fn client_of(&self, program: &str, topic: &str, more: &[&str]) -> Command {
        let mut command = Command::new(program);
        command.args(["-h", "127.0.0.1", "-p", &self.port, "-q", "1", "-t", topic]).args(more);
        command
    }

    /// Publishes every line as a message, and waits until the broker has them all.
    pub(crate) fn publish(&self, lines: &[String], more: &[&str]) {
        self.publish_to("plant/throttle", lines, more);
    }

    pub(crate) fn publish_to(&self, topic: &str, lines: &[String], more: &[&str]) {
        let mut command = self.client_of("mosquitto_pub", topic, &[more, &["-l"]].concat());
        let mut publisher = Running(command.stdin(Stdio::piped()).spawn().unwrap());
        let mut input = publisher.0.stdin.take().unwrap();
        lines.iter().for_each(|line| writeln!(input, "{line}").unwrap());
        drop(input);
        assert!(publisher.0.wait().unwrap().success());
    }
}

/// `greybox watch --json` on the throttle of a bench.
pub(crate) fn watch(bench: &Bench) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_greybox"));
    command.args(["watch", "throttle.toml", "--json"]).current_dir(bench.path("."));
    command
}

/// A `greybox watch --json` that runs.
pub(crate) struct Watching {
    pub(crate) process: Running,
    pub(crate) input: Option<ChildStdin>,
    lines: Receiver<String>,
}

impl Watching {
    pub(crate) fn start(bench: &Bench, arguments: &[&str]) -> Watching {
        Watching::start_as(watch(bench).args(arguments))
    }

    /// Of a [`watch`] with its arguments.
    pub(crate) fn start_as(command: &mut Command) -> Watching {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let (to, lines) = mpsc::channel();
        thread::spawn(move || {
            for line in out.lines().map_while(Result::ok) {
                let _ = to.send(line);
            }
        });
        let input = child.stdin.take();
        Watching { process: Running(child), input, lines }
    }

    /// The next line, and what it says.
    pub(crate) fn next(&self) -> (String, Value) {
        let line = self.lines.recv_timeout(PATIENCE).unwrap();
        let value = serde_json::from_str(&line).unwrap();
        (line, value)
    }

    /// The lines up to the first event of this kind, which is the last of them.
    pub(crate) fn until(&self, kind: &str) -> Vec<String> {
        let mut lines = Vec::new();
        loop {
            let (line, value) = self.next();
            lines.push(line);
            if value["event"] == kind {
                return lines;
            }
        }
    }

    /// The lines that have come meanwhile.
    pub(crate) fn rest(&self) -> Vec<String> {
        self.lines.try_iter().collect()
    }

    /// Waits until the file has this state.
    pub(crate) fn until_saved(&self, bench: &Bench, name: &str, state: &str) {
        until("the state is saved", || {
            std::fs::read_to_string(bench.path(name)).is_ok_and(|found| found == state)
        });
    }
}
