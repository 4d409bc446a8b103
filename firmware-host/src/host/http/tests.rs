use super::*;

fn read(bytes: &[u8]) -> Result<Option<Request>, Refusal> {
    Request::read(&mut &bytes[..])
}

#[test]
fn requests_are_read() {
    let text = b"POST /command?token=abc&x=1 HTTP/1.1\r\nHost: localhost:8080\r\n\
                 content-length: 4\r\n\r\nbodyGET / HTTP/1.0\n\n";
    let mut reader = &text[..];
    let first = Request::read(&mut reader).expect("reads").expect("there");
    assert_eq!((first.method, first.path.as_str()), (Method::Post, "/command"));
    assert_eq!((first.query("token"), first.query("tok")), (Some("abc"), None));
    assert_eq!((first.body.as_slice(), first.keep), (&b"body"[..], true));
    assert_eq!(first.header("host"), Some("localhost:8080"));
    let second = Request::read(&mut reader).expect("reads").expect("there");
    assert!(second.method == Method::Get && !second.keep);
    assert!(Request::read(&mut reader).expect("end").is_none());
}

#[test]
fn bad_requests_are_refused() {
    let many = "a: b\r\n".repeat(HEADERS + 1);
    let long = "x".repeat(HEAD);
    for (text, status) in [
        ("hello\r\n\r\n".to_owned(), 400),
        ("GET /\r\n\r\n".into(), 400),
        ("GET / HTTP/1.1".into(), 400),
        ("GET / HTTP/1.1\r\nHost: x\r\n".into(), 400),
        ("GET / HTTP/1.1\r\nno colon\r\n\r\n".into(), 400),
        ("GET / HTTP/1.1\r\nsp ace: x\r\n\r\n".into(), 400),
        ("GET / HTTP/1.1\r\na: \u{1}\r\n\r\n".into(), 400),
        ("GET http://x/ HTTP/1.1\r\n\r\n".into(), 400),
        ("get / HTTP/1.1\r\n\r\n".into(), 400),
        ("DELETE / HTTP/1.1\r\n\r\n".into(), 405),
        ("GET / HTTP/2.0\r\n\r\n".into(), 505),
        ("GET / SPDY/1\r\n\r\n".into(), 400),
        (format!("GET /{long} HTTP/1.1\r\n\r\n"), 431),
        (format!("GET / HTTP/1.1\r\n{many}\r\n"), 431),
        ("POST / HTTP/1.1\r\nContent-Length: 4097\r\n\r\n".into(), 413),
        ("POST / HTTP/1.1\r\nContent-Length: 99999999999999999999999\r\n\r\n".into(), 413),
        ("POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n".into(), 400),
        ("POST / HTTP/1.1\r\nContent-Length: 1\r\nContent-Length: 1\r\n\r\na".into(), 400),
        ("POST / HTTP/1.1\r\nContent-Length: 5\r\n\r\nabc".into(), 400),
        ("POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n".into(), 501),
    ] {
        let got = read(text.as_bytes()).map(|r| r.is_some());
        assert_eq!(got.map_err(|e| e.status), Err(status), "{text:.60}");
    }
}

proptest::proptest! {
    #[test]
    fn any_bytes_are_survived(bytes: Vec<u8>) {
        let _ = read(&bytes);
        let _ = read(&[b"GET / HTTP/1.1\r\n".as_slice(), &bytes, b"\r\n\r\n"].concat());
    }
}

fn ask(access: &Access, head: &str) -> u16 {
    let request = read(format!("GET {head}\r\n\r\n").as_bytes()).expect("reads").expect("there");
    access.check(&request).map_or_else(|e| e.status, |()| 200)
}

#[test]
fn the_token_opens_and_nothing_else_does() {
    let token = "0123456789abcdef-";
    let access = Access::new("preview", "0.0.0.0:0", Some(token), None).expect("access");
    let with = |t: &str| ask(&access, &format!("/?token={t} HTTP/1.1\r\nHost: board"));
    assert_eq!(with(token), 200);
    for wrong in ["", "0123456789abcdef", "0123456789abcdef--", "1123456789abcdef-"] {
        assert_eq!(with(wrong), 401, "{wrong}");
    }
    let header = format!("/ HTTP/1.1\r\nAuthorization: Bearer {token}\r\nHost: board");
    assert_eq!(ask(&access, &header), 200);
    assert_eq!(ask(&access, &format!("{header}\r\nOrigin: http://board")), 200);
    assert_eq!(ask(&access, &format!("{header}\r\nOrigin: http://other")), 403);
    assert!(!format!("{access:?}").contains(token));
}

#[test]
fn loopback_needs_no_token_but_its_name() {
    let access = Access::new("preview", "127.0.0.1:0", None, None).expect("access");
    for (host, status) in [
        ("127.0.0.1:8080", 200),
        ("localhost", 200),
        ("[::1]:8080", 200),
        ("rebound.example:8080", 403),
        ("192.168.1.5", 403),
    ] {
        assert_eq!(ask(&access, &format!("/ HTTP/1.1\r\nHost: {host}")), status, "{host}");
    }
    assert_eq!(ask(&access, "/ HTTP/1.1\r\nA: b"), 403);
    let cross = "/ HTTP/1.1\r\nHost: localhost\r\nOrigin: https://example.org";
    assert_eq!(ask(&access, cross), 403);
}

#[test]
fn open_addresses_without_a_token_are_refused() {
    let file = tempfile::NamedTempFile::new().expect("temp");
    std::fs::write(file.path(), "abcdefghijklmnopqrst\n").expect("write");
    let of = |bind, token, file| {
        Access::new("output.preview", bind, token, file).map(drop).map_err(|e| e.to_string())
    };
    assert_eq!(of("0.0.0.0:0", None, Some(file.path())), Ok(()));
    for (bind, token, path, word) in [
        ("0.0.0.0:8080", None, None, "token"),
        ("[::]:8080", None, None, "token"),
        ("127.0.0.1:0", Some("short"), None, "at least 16"),
        ("0.0.0.0:0", Some("with spaces and more"), None, "letters"),
        ("nonsense", None, None, "bind"),
        ("127.0.0.1:0", Some("abcdefghijklmnopqrst"), Some(file.path()), "exclude"),
        ("127.0.0.1:0", None, Some(Path::new("no/such/file")), "no/such/file"),
    ] {
        let error = of(bind, token, path).expect_err(bind);
        assert!(error.contains(word) && error.contains("output.preview."), "{error}");
    }
}
