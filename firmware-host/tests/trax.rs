//! `tsda trax` as its own process: over pipes and over a socket, with the embedded model.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tsda_host::picture::Picture;
use tsda_host::render::{Clip, ClipConfig};
use tsda_host::trax::{Kind, Message, MessageReader, Region};
use tsda_runtime::{BBox, Modality};

/// A few frames of the rendered clip as files, RGB and thermal.
struct Frames {
    clip: Clip,
    dir: tempfile::TempDir,
}

impl Frames {
    fn new() -> Self {
        let config = ClipConfig { frames: 48, ..ClipConfig::default() };
        Self { clip: Clip::new(config), dir: tempfile::tempdir().expect("temp") }
    }

    fn file(&self, frame: usize, modality: Modality) -> PathBuf {
        let path = self.dir.path().join(format!("{modality} {frame}.png"));
        let mut picture = Picture::default();
        self.clip.render(frame, modality, &mut picture);
        let colour =
            if picture.channels == 1 { image::ColorType::L8 } else { image::ColorType::Rgb8 };
        image::save_buffer(&path, &picture.data, 320, 240, colour).expect("png");
        path
    }

    fn url(&self, frame: usize, modality: Modality) -> String {
        format!("file://{}", self.file(frame, modality).display())
    }
}

fn command(args: &[&str], dir: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tsda"));
    command.arg("trax").args(args).current_dir(dir);
    command.env("TRAX", "1").env_remove("TRAX_SOCKET").env_remove("TRAX_IN").env_remove("TRAX_OUT");
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The client's side of a session.
struct Client<R, W> {
    input: MessageReader<R>,
    output: W,
}

impl<R: Read, W: Write> Client<R, W> {
    fn send(&mut self, message: &Message) {
        let mut line = Vec::new();
        message.encode(&mut line);
        self.output.write_all(&line).expect("the server listens");
        self.output.flush().expect("the server listens");
    }

    fn receive(&mut self) -> Message {
        self.input.next_message().expect("a message").expect("not the end")
    }

    /// Sends a frame; answers the box and the state message.
    fn track(&mut self, pictures: &[String]) -> (BBox, Message) {
        let frame = pictures.iter().fold(Message::new(Kind::Frame), |m, p| m.arg(p.as_str()));
        self.send(&frame);
        let state = self.receive();
        assert_eq!(state.kind, Kind::State, "{state:?}");
        let region = Region::parse(&state.args[0]).expect("region");
        (region.bounds().expect("box"), state)
    }
}

fn initialize(b: BBox) -> Message {
    Message::new(Kind::Initialize).arg(Region::Rectangle(b).to_string())
}

/// Ends within the three seconds that the toolkit grants, and returns exit code and stderr.
fn ended(mut child: Child) -> (Option<i32>, String) {
    let start = Instant::now();
    while child.try_wait().expect("a child").is_none() {
        if start.elapsed() > Duration::from_secs(20) {
            child.kill().expect("kill");
            panic!("the server did not end");
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let mut text = String::new();
    child.stderr.take().expect("pipe").read_to_string(&mut text).expect("text");
    (child.wait().expect("a child").code(), text)
}

#[test]
fn over_pipes_a_target_is_followed_through_a_sensor_switch() {
    let frames = Frames::new();
    let args = ["--channels", "color,ir", "--policy", "switch:6"];
    let mut child = command(&args, frames.dir.path()).spawn().expect("starts");
    let mut client = Client {
        input: MessageReader::new(child.stdout.take().expect("pipe"), 1 << 20),
        output: child.stdin.take().expect("pipe"),
    };
    let hello = client.receive();
    assert_eq!(hello.kind, Kind::Hello);
    assert_eq!(hello.property("trax.version"), Some("4"));
    assert_eq!(hello.property("trax.channels"), Some("color;ir;"));

    let mut first_run = Vec::new();
    for round in 0..2 {
        // The second round must not remember the first.
        if round == 1 {
            client.send(&Message::new(Kind::Initialize));
        }
        let truth = frames.clip.truth(0);
        client.send(&initialize(truth));
        let mut answers = Vec::new();
        for i in 0..12 {
            let pictures = [frames.url(i, Modality::Rgb), frames.url(i, Modality::Thermal)];
            let (found, state) = client.track(&pictures);
            let sensor = if i < 6 { "rgb" } else { "thermal" };
            assert_eq!(state.property("modality"), Some(sensor), "frame {i}");
            let confidence: f32 =
                state.property("confidence").and_then(|c| c.parse().ok()).expect("a number");
            assert!((0.0..=1.0).contains(&confidence));
            assert!(state.property("state").is_some());
            let overlap = found.iou(&frames.clip.truth(i));
            assert!(overlap > 0.3, "frame {i}: {found:?}, overlap {overlap}");
            if i == 0 {
                assert!(found.iou(&truth) > 0.999, "{found:?} is not {truth:?}");
            }
            answers.push(state);
        }
        if round == 0 {
            first_run = answers;
        } else {
            assert_eq!(answers, first_run, "the same frames give the same answers");
        }
    }
    client.send(&Message::new(Kind::Quit));
    let (code, text) = ended(child);
    assert_eq!(
        (code, text.as_str()),
        (Some(0), "tsda: trax: 2 targets, 24 frames; the client ended the session\n")
    );
}

#[test]
fn over_a_socket_standard_output_stays_silent() {
    let frames = Frames::new();
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = listener.local_addr().expect("address").port().to_string();
    let mut child = command(&["--trax-version", "3"], frames.dir.path())
        .env("TRAX_SOCKET", &port)
        .spawn()
        .expect("starts");
    let (stream, _) = listener.accept().expect("the server connects");
    let mut client = Client {
        input: MessageReader::new(stream.try_clone().expect("clone"), 1 << 20),
        output: stream,
    };
    assert_eq!(client.receive().property("trax.version"), Some("3"));
    let truth = frames.clip.truth(0);
    let region = Region::Polygon(vec![
        [truth.x, truth.y],
        [truth.right(), truth.y],
        [truth.right(), truth.bottom()],
        [truth.x, truth.bottom()],
    ]);
    let first = frames.url(0, Modality::Rgb);
    client.send(&Message::new(Kind::Initialize).arg(first).arg(region.to_string()));
    assert_eq!(client.receive().kind, Kind::State);
    // Bytes of the next frame come in pieces.
    let mut line = Vec::new();
    Message::new(Kind::Frame).arg(frames.url(1, Modality::Rgb)).encode(&mut line);
    for piece in line.chunks(7) {
        client.output.write_all(piece).expect("write");
    }
    assert_eq!(client.receive().kind, Kind::State);
    let mut stdout = child.stdout.take().expect("pipe");
    drop(client);
    // The end of the stream is an end like any other.
    let (code, text) = ended(child);
    assert_eq!(code, Some(0), "{text}");
    let mut printed = String::new();
    stdout.read_to_string(&mut printed).expect("text");
    assert_eq!(printed, "");
}

/// Runs a session of fixed lines; answers exit code, stdout and stderr.
fn play(args: &[&str], variables: &[(&str, &str)], lines: &[u8]) -> (Option<i32>, String, String) {
    let dir = tempfile::tempdir().expect("temp");
    let mut command = command(args, dir.path());
    for (name, value) in variables {
        command.env(name, value);
    }
    let mut child = command.spawn().expect("starts");
    // The server may end before it has read everything.
    let _ = child.stdin.take().expect("pipe").write_all(lines);
    let mut stdout = String::new();
    child.stdout.take().expect("pipe").read_to_string(&mut stdout).expect("text");
    let (code, stderr) = ended(child);
    assert!(!stderr.contains("panicked"), "{stderr}");
    (code, stdout, stderr)
}

#[test]
fn what_goes_wrong_is_said_to_client_and_user() {
    let outside = b"@@TRAX:initialize \"nan,1,2,3\"\n";
    for (args, variables, lines, code, words, told) in [
        (&["--bundle", "none.tsda"][..], &[][..], &b""[..], 2, "none.tsda", true),
        (&[], &[], outside, 2, "number 1 is not finite", true),
        (&[], &[], b"@@TRAX:frame \"/none.png\"\n", 2, "there is no target", true),
        (&[], &[], b"@@TRAX:frame \"/none", 3, "the stream ended inside it", true),
        (&["--policy", "ir"], &[], b"", 2, "add --channels color,ir", true),
        (&["--channels", "ir", "--trax-version", "1"], &[], b"", 2, "only have color", true),
        (&["--channels", "depth"], &[], b"", 2, "expected color, ir", false),
        (&["--trax-version", "5"], &[], b"", 2, "1..=4", false),
        (&[], &[("TRAX_SOCKET", "http")], b"", 2, "TRAX_SOCKET=http", false),
        (&[], &[("TRAX_SOCKET", "1")], b"", 2, "nobody can be reached", false),
        (&[], &[("TRAX_IN", "x")], b"", 2, "TRAX_IN=x", false),
        (&[], &[("TRAX_OUT", "977")], b"", 2, "TRAX_OUT=977", false),
    ] {
        let (got, stdout, stderr) = play(args, variables, lines);
        assert_eq!(got, Some(code), "{args:?}: {stderr}");
        assert!(stderr.contains(words), "{args:?}: no \"{words}\" in: {stderr}");
        let quit = stdout.lines().last().unwrap_or_default();
        assert_eq!(quit.starts_with("@@TRAX:quit \"trax.reason="), told, "{args:?}: {stdout}");
        assert_eq!(quit.contains(words), told, "{args:?}: {stdout}");
    }
}

#[cfg(unix)]
#[test]
fn descriptors_named_in_the_environment_are_used() {
    let dir = tempfile::tempdir().expect("temp");
    let lines = dir.path().join("client.txt");
    std::fs::write(&lines, "@@TRAX:quit\n").expect("write");
    // The shell opens the descriptors, as a client would.
    let script = format!("exec \"{}\" trax 5<client.txt 6>server.txt", env!("CARGO_BIN_EXE_tsda"));
    let output = Command::new("sh")
        .args(["-c", &script])
        .current_dir(dir.path())
        .env_remove("TRAX_SOCKET")
        .env("TRAX_IN", "5")
        .env("TRAX_OUT", "6")
        .stdin(Stdio::null())
        .output()
        .expect("a shell");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.stdout.is_empty());
    let file = std::fs::File::open(dir.path().join("server.txt")).expect("written");
    let line = BufReader::new(file).lines().next().expect("a line").expect("text");
    assert!(line.starts_with("@@TRAX:hello "), "{line}");
}
