use super::*;
use proptest::prelude::*;
use serde::Deserialize;
use std::io::Cursor;
use std::path::{Path, PathBuf};

#[derive(Deserialize)]
struct Expected {
    format: String,
    tensors: BTreeMap<String, ExpectedTensor>,
    others: Vec<String>,
}

#[derive(Deserialize)]
struct ExpectedTensor {
    shape: Vec<usize>,
    /// All values, or the first ones.
    values: Vec<f64>,
    sum: f64,
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/import")
}

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(folder().join(name)).unwrap()
}

fn read(bytes: &[u8]) -> Result<Checkpoint, TorchError> {
    TorchFile::open(Cursor::new(bytes))?.checkpoint()
}

/// Compares every file of a folder with its `expected.json`.
pub(in crate::import) fn check_folder(folder: &Path) {
    let text = std::fs::read_to_string(folder.join("expected.json")).unwrap();
    let expected: BTreeMap<String, Expected> = serde_json::from_str(&text).unwrap();
    assert!(expected.len() >= 7);
    for (file, want) in expected {
        let got = read(&std::fs::read(folder.join(&file)).unwrap()).unwrap();
        let format = if want.format == "zip" { TorchFormat::Zip } else { TorchFormat::Legacy };
        assert_eq!(got.format, format, "{file}");
        let names: Vec<&str> = got.dict.names().collect();
        assert_eq!(names, want.tensors.keys().map(String::as_str).collect::<Vec<_>>(), "{file}");
        let mut others: Vec<&str> = got.others.iter().map(|(name, _)| name.as_str()).collect();
        others.sort_unstable();
        assert_eq!(others, want.others, "{file}");
        let mut worst = 0.0f64;
        for (name, want) in &want.tensors {
            let tensor = got.dict.get(name).unwrap();
            assert_eq!(tensor.shape, want.shape, "{file} {name}");
            assert_eq!(tensor.values.len(), want.shape.iter().product::<usize>(), "{file} {name}");
            for (a, b) in tensor.values.iter().zip(&want.values) {
                worst = worst.max((f64::from(*a) - b).abs() / b.abs().max(1.0));
            }
            let sum: f64 = tensor.values.iter().map(|v| f64::from(*v)).sum();
            assert!(
                (sum - want.sum).abs() <= 1e-6 * want.sum.abs().max(1.0),
                "{file} {name}: {sum}"
            );
        }
        println!("{file}: {} tensors, largest relative difference {worst:.1e}", names.len());
        assert!(worst <= 1e-8, "{file}: {worst}");
    }
}

#[test]
fn files_of_torch_are_read_to_the_bit() {
    check_folder(&folder());
}

#[test]
fn where_the_weights_are_and_what_is_beside_them() {
    let cases = [
        ("traits.pth", None, vec![]),
        ("traits_protocol4.pth", Some("state_dict"), vec!["epoch"]),
        ("traits_protocol1.pth", Some("model"), vec![]),
        (
            "pytracking.pth.tar",
            Some("net"),
            vec!["epoch", "actor_type", "net_type", "net_info", "optimizer", "stats", "settings"],
        ),
    ];
    for (file, key, beside) in cases {
        let got = read(&bytes(file)).unwrap();
        assert_eq!(got.key.as_deref(), key, "{file}");
        let keys: Vec<&str> = got.beside.iter().map(|(k, _)| k.as_str()).collect();
        assert_eq!(keys, beside, "{file}");
    }
    let traits = read(&bytes("traits.pth")).unwrap();
    assert_eq!(traits.ties, [["alias", "shared.whole"]]);
    let others: Vec<(&str, &str)> =
        traits.others.iter().map(|(n, t)| (n.as_str(), t.as_str())).collect();
    assert_eq!(others, [("version", "int"), ("note", "str")]);
}

#[test]
fn constructors_of_unknown_classes_are_understood() {
    let got = read(&bytes("pytracking.pth.tar")).unwrap();
    let c = got.constructor.unwrap();
    assert_eq!(
        (c.function.as_str(), c.module.as_str()),
        ("tompnet_tiny", "ltr.models.tracking.tompnet")
    );
    assert!(c.args.is_empty());
    // A numpy integer in the file.
    assert_eq!(c.kwargs["filter_size"], 3);
    assert_eq!(c.kwargs["nhead"], 2);
    assert_eq!(c.kwargs["frozen_backbone_layers"], serde_json::json!(["conv1", "bn1"]));
    assert_eq!(c.kwargs["backbone_pretrained"], true);
    let fg = "head.filter_predictor.query_embed_fg";
    assert_eq!(got.ties, [[format!("{fg}.weight"), format!("{fg}_decoder.weight")]]);
    let settings = got.beside.iter().find(|(key, _)| key == "settings").unwrap();
    assert_eq!(settings.1, "ltr.admin.settings.Settings");
}

#[test]
fn truncated_files_are_errors_at_every_length() {
    for (file, step) in [
        ("traits.pth", 1),
        ("traits_legacy.pth", 1),
        ("traits_protocol1.pth", 1),
        ("traits_protocol4.pth", 1),
        ("module.pth", 1),
        ("resnet.pth", 61),
        ("pytracking.pth.tar", 499),
    ] {
        let whole = bytes(file);
        for length in (0..whole.len()).step_by(step).chain([whole.len() - 1]) {
            let result = read(&whole[..length]);
            assert!(result.is_err(), "{file} cut to {length} of {} bytes is read", whole.len());
        }
    }
}

#[test]
fn flipped_bits_never_panic_and_altered_numbers_are_noticed() {
    for file in ["traits.pth", "traits_legacy.pth", "traits_protocol1.pth"] {
        let whole = bytes(file);
        let mut damaged = whole.clone();
        let mut errors = 0;
        for i in 0..whole.len() {
            for mask in [0x01, 0x80, 0xff] {
                damaged[i] = whole[i] ^ mask;
                errors += usize::from(read(&damaged).is_err());
            }
            damaged[i] = whole[i];
        }
        println!("{file}: {errors} of {} alterations are errors", 3 * whole.len());
        assert!(errors > whole.len() / 10, "{file}: {errors}");
    }
    // A number of a tensor, which only the checksum can notice.
    let mut damaged = bytes("traits.pth");
    let pattern: Vec<u8> = [42.0f32].iter().flat_map(|v| v.to_le_bytes()).collect();
    let at = damaged.windows(4).position(|w| w == pattern).unwrap();
    damaged[at] ^= 1;
    let error = read(&damaged).unwrap_err().to_string();
    assert!(error.contains("scalar") && error.contains("checksum"), "{error}");
}

/// A legacy file whose saved object is this pickle.
fn legacy(object: &[u8], storages: &[(&str, &[u8])]) -> Vec<u8> {
    let mut file = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.".to_vec();
    file.extend(b"\x80\x02M\xe9\x03.");
    file.extend(b"\x80\x02}X\x0d\x00\x00\x00little_endian\x88s.");
    file.extend(object);
    file.extend(b"\x80\x02](");
    for (key, _) in storages {
        file.extend([b'X', key.len() as u8, 0, 0, 0]);
        file.extend(key.bytes());
    }
    file.extend(b"e.");
    for (_, bytes) in storages {
        file.extend((bytes.len() as u64 / 4).to_le_bytes());
        file.extend(*bytes);
    }
    file
}

/// `{"w": tensor}` on a float storage "0", written with text opcodes.
fn tensor(offset: &str, shape: &str, strides: &str) -> Vec<u8> {
    let numbers =
        |list: &str| -> String { list.split_whitespace().map(|n| format!("I{n}\n")).collect() };
    format!(
        "}}Vw\nctorch._utils\n_rebuild_tensor_v2\n((Vstorage\nctorch\nFloatStorage\nV0\nVcpu\nI4\nNtQ\
         I{offset}\n({}t({}tI00\nNtRs.",
        numbers(shape),
        numbers(strides)
    )
    .into_bytes()
}

#[test]
fn what_a_file_claims_is_checked_before_it_is_believed() {
    let four: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let with = |object: Vec<u8>| read(&legacy(&object, &[("0", &four)]));
    let good = with(tensor("1", "3", "1")).unwrap();
    assert_eq!(good.dict.get("w").unwrap().values, [2.0, 3.0, 4.0]);
    let turned = with(tensor("0", "2 2", "1 2")).unwrap();
    assert_eq!(turned.dict.get("w").unwrap().values, [1.0, 3.0, 2.0, 4.0]);
    let cases: [(&str, Vec<u8>, &str); 8] = [
        ("offset beyond the storage", tensor("2", "3", "1"), "does not fit"),
        ("negative offset", tensor("-1", "3", "1"), "not understood"),
        ("stride beyond the storage", tensor("0", "2", "4"), "does not fit"),
        ("a terabyte out of one number", tensor("0", "1099511627776", "0"), "larger"),
        (
            "more elements than a number holds",
            tensor("0", "9223372036854775807 9", "0 0"),
            "larger",
        ),
        ("fewer strides than axes", tensor("0", "2 2", "1"), "not understood"),
        ("stack empty", b"R.".to_vec(), "stack"),
        ("text of 2^60 bytes", b"\x8d\0\0\0\0\0\0\0\x10.".to_vec(), "longer"),
    ];
    for (case, object, want) in cases {
        let error = with(object).map(|c| c.dict).unwrap_err().to_string();
        assert!(error.contains(want), "{case}: {error}");
    }
    let error = read(&legacy(b"}Va\nI1\ns.", &[])).unwrap_err().to_string();
    assert!(error.contains("no state dict") && error.contains("[\"a\"]"), "{error}");
    let lost = read(&legacy(&tensor("0", "4", "1"), &[])).unwrap_err().to_string();
    assert!(lost.contains("tensor w") && lost.contains("storage 0"), "{lost}");
    // 40 names for one storage of a megabyte: more than the file can justify.
    let big = vec![0u8; 1 << 20];
    let one = tensor("0", "262144", "1");
    let mut many = b"}".to_vec();
    for i in 0..40 {
        many.extend(format!("V{i}\n").bytes());
        many.extend(&one[4..one.len() - 2]);
        many.push(b's');
    }
    many.push(b'.');
    let error = read(&legacy(&many, &[("0", &big)])).unwrap_err().to_string();
    assert!(error.contains("larger than the file"), "{error}");
}

#[test]
fn foreign_byte_order_and_other_files_are_refused_with_advice() {
    let mut big = legacy(&tensor("0", "4", "1"), &[("0", &[0; 16])]);
    let at = big.iter().position(|b| *b == 0x88).unwrap();
    big[at] = 0x89;
    let error = read(&big).unwrap_err().to_string();
    assert!(error.contains("big-endian") && error.contains("little-endian"), "{error}");
    let mut zipped = bytes("traits.pth");
    // `little` in the zip's byteorder entry; its checksum too.
    let name = b"byteorderlittle";
    if let Some(at) = zipped.windows(6).position(|w| w == b"little") {
        zipped[at..at + 6].copy_from_slice(b"big   ");
        assert!(read(&zipped).is_err());
    } else {
        panic!("no {name:?} in the file");
    }
    for (file, want) in [
        (b"hello world, this is text".as_slice(), "neither"),
        (b"".as_slice(), "neither"),
        (b"\x80\x02K\x01.".as_slice(), "neither"),
        (b"PK\x05\x06\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0".as_slice(), "data.pkl"),
    ] {
        let error = read(file).unwrap_err().to_string();
        assert!(error.contains(want), "{error}");
    }
}

#[test]
fn deep_and_self_containing_values_do_no_harm() {
    // A million lists in one another.
    let mut deep = vec![b']'; 1_000_000];
    deep.extend(vec![b'a'; 999_999]);
    deep.push(b'.');
    assert!(matches!(read(&legacy(&deep, &[])), Err(TorchError::NoWeights { .. })));
    // More values than are allowed.
    let mut many = vec![b'N'; 3_000_000];
    many.push(b'.');
    assert!(matches!(read(&legacy(&many, &[])), Err(TorchError::Pickle { .. })));
    // {"net": itself}, and a constructor whose arguments hold themselves.
    let own = b"}q\0X\x03\0\0\0neth\0s.";
    assert!(matches!(read(&legacy(own, &[])), Err(TorchError::NoWeights { .. })));
    let mut object = tensor("0", "4", "1");
    object.truncate(object.len() - 1);
    object.extend(b"Vconstructor\ncm\nC\n)R}Vargs\n](g9\ng9\n0000"); // a broken end, on purpose
    assert!(read(&legacy(&object, &[("0", &[0; 16])])).is_err());
    let mut object = tensor("0", "4", "1");
    object.truncate(object.len() - 1);
    object.extend(b"Vconstructor\ncm\nC\n)R}Vargs\n]p9\n(g9\ng9\nesbs.");
    let got = read(&legacy(&object, &[("0", &[0; 16])])).unwrap();
    let args = got.constructor.unwrap().args;
    assert_eq!(args.len(), 2);
    assert!(serde_json::to_string(&args).unwrap().len() < 100_000);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, ..ProptestConfig::default() })]

    #[test]
    fn arbitrary_bytes_never_panic(data in proptest::collection::vec(any::<u8>(), 0..400)) {
        let _ = read(&data);
        let mut zipped = b"PK\x03\x04".to_vec();
        zipped.extend(&data);
        zipped.extend(b"PK\x05\x06");
        zipped.extend(&data[..data.len().min(18)]);
        let _ = read(&zipped);
        let _ = read(&legacy(&data, &[("0", &[0; 16])]));
    }

    /// Pieces that make sense, in an order that mostly does not.
    #[test]
    fn shuffled_opcodes_never_panic(pieces in proptest::collection::vec(0usize..PIECES.len(), 0..60)) {
        let mut object: Vec<u8> = pieces.iter().flat_map(|i| PIECES[*i].to_vec()).collect();
        object.push(b'.');
        let _ = read(&legacy(&object, &[("0", &[0; 16])]));
    }
}

const PIECES: [&[u8]; 28] = [
    b"}",
    b"]",
    b")",
    b"(",
    b"t",
    b"u",
    b"s",
    b"a",
    b"e",
    b"b",
    b"R",
    b"Q",
    b"0",
    b"1",
    b"2",
    b"q\0",
    b"h\0",
    b"\x94",
    b"\x85",
    b"\x86",
    b"\x87",
    b"\x93",
    b"\x8f\x90",
    b"Vnet\n",
    b"I4\n",
    b"V0\n",
    b"ctorch._utils\n_rebuild_tensor_v2\n",
    b"(Vstorage\nctorch\nFloatStorage\nV0\nVcpu\nI4\nNtQ",
];
