//! As a service of systemd: what the program tells its manager, and the unit of docs/deploy.
#![cfg(target_os = "linux")]

use std::fs;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A second of pictures, two seconds without any, then pictures without end.
const CONFIG: &str = r#"
[[source]]
name = "rgb"
sensor = "rgb"
render = { frames = 20, repeat = true }
faults = [{ kind = "stop", at = 25, frames = 50 }]
"#;
const WATCHDOG: Duration = Duration::from_millis(300);

/// Ends the program whatever happens.
struct Service(Child);

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What a service manager hears, and when.
fn hear(manager: &UnixDatagram) -> (Instant, String) {
    let mut bytes = [0; 256];
    let n = manager.recv(&mut bytes).expect("a message within the time");
    (Instant::now(), String::from_utf8_lossy(&bytes[..n]).into_owned())
}

#[test]
fn the_service_manager_hears_of_the_start_of_pictures_and_of_the_end() {
    let dir = tempfile::tempdir().expect("temp");
    let (config, socket) = (dir.path().join("host.toml"), dir.path().join("notify"));
    fs::write(&config, CONFIG).expect("write");
    let manager = UnixDatagram::bind(&socket).expect("socket");
    manager.set_read_timeout(Some(Duration::from_secs(60))).expect("timeout");
    let child = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(["run", "--config"])
        .arg(&config)
        .env("NOTIFY_SOCKET", &socket)
        .env("WATCHDOG_USEC", WATCHDOG.as_micros().to_string())
        .env_remove("WATCHDOG_PID")
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut service = Service(child);
    assert_eq!(hear(&manager).1, "READY=1\nSTATUS=running");
    let (mut last, mut longest, mut after) = (Instant::now(), Duration::ZERO, 0);
    // Signs of life, a silence as long as the outage, and signs of life again.
    while after < 5 {
        let (at, text) = hear(&manager);
        assert_eq!(text, "WATCHDOG=1");
        longest = longest.max(at - last);
        after += u32::from(longest > Duration::from_secs(1));
        last = at;
    }
    println!("longest silence: {longest:?}, of an outage of 2 s");
    // From the last picture before the outage to the first after it; a machine that is busy only
    // makes it longer.
    assert!(longest > Duration::from_millis(1700), "fed without pictures: {longest:?}");
    let pid = service.0.id().to_string();
    let told = Command::new("kill").args(["-TERM", &pid]).status().expect("kill");
    assert!(told.success());
    loop {
        match hear(&manager).1.as_str() {
            "WATCHDOG=1" => {}
            text => break assert_eq!(text, "STOPPING=1"),
        }
    }
    assert!(service.0.wait().expect("ends").success());
}

#[test]
fn systemd_understands_the_unit() {
    let there = Command::new("systemd-analyze").arg("--version").output();
    if !there.is_ok_and(|o| o.status.success()) {
        println!("skipped: no systemd-analyze");
        return;
    }
    let unit = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/deploy/tsda.service");
    let text = fs::read_to_string(unit).expect("unit");
    let installed = "/usr/local/bin/tsda";
    assert!(text.contains(installed));
    let dir = tempfile::tempdir().expect("temp");
    // A program that is not there is an error of its own.
    let good = text.replace(installed, env!("CARGO_BIN_EXE_tsda"));
    // Which of them are found to be wrong.
    let typo = good.replace("WatchdogSec=30", "WatchdogSecs=30");
    let value = good.replace("LimitRTPRIO=50", "LimitRTPRIO=high");
    for (name, text, right) in
        [("good", good, true), ("typo", typo, false), ("value", value, false)]
    {
        let folder = dir.path().join(name);
        fs::create_dir(&folder).expect("folder");
        let path = folder.join("tsda.service");
        fs::write(&path, text).expect("write");
        let said = Command::new("systemd-analyze").args(["verify", "--man=no"]).arg(&path).output();
        let said = said.expect("runs");
        let words = String::from_utf8_lossy(&said.stderr);
        // Other units of this machine are none of ours.
        let ours: Vec<&str> = words.lines().filter(|l| l.contains("tsda.service")).collect();
        assert_eq!(ours.is_empty(), right, "{name}: {words}");
    }
}
