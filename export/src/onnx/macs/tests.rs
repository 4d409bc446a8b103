//! Hand-computed counts, from graphs and from files.

use super::super::graph::{Attribute, Data, Elem, Port};
use super::super::{Storage, model};
use super::*;

type Attributes = Vec<(&'static str, Attribute)>;

fn ints(values: &[i64]) -> Attribute {
    Attribute::Ints(values.to_vec())
}

/// A graph of one operation on an input and perhaps a constant.
fn graph(
    op: &'static str,
    x: &[usize],
    constant: Option<(&[usize], Data)>,
    out: &[usize],
    attributes: Attributes,
) -> Graph {
    let mut graph = Graph::new("g", "");
    let input = graph.add_value("x", x, Elem::F32);
    graph.inputs.push(Port { value: input, doc: String::new() });
    let mut inputs = vec![Some(input)];
    if let Some((dims, data)) = constant {
        inputs.push(Some(graph.add_constant("w", dims, data)));
    }
    let output = graph.add_value("layer/op", out, Elem::F32);
    graph.nodes.push(Node { op, inputs, output, attributes });
    graph.outputs.push(Port { value: output, doc: String::new() });
    graph
}

fn floats(dims: &[usize]) -> Data {
    Data::F32(vec![0.5; dims.iter().product()])
}

/// Total of the graph, which must also be that of the file.
fn total(graph: &Graph) -> u64 {
    let counted = count(graph);
    assert_eq!(count_model(&model(graph, Storage::Inline)).unwrap(), counted);
    counted.iter().map(|n| n.macs).sum()
}

#[test]
fn products_by_hand() {
    type Case<'a> = (&'a str, &'static str, &'a [usize], &'a [usize], &'a [usize], Attributes, u64);
    let pads = || ("pads", ints(&[1, 1, 1, 1]));
    let cases: Vec<Case<'_>> = vec![
        // 8 x 10 outputs of 5 channels, each 3 x 3 x 3.
        ("conv", "Conv", &[1, 3, 8, 10], &[5, 3, 3, 3], &[1, 5, 8, 10], vec![pads()], 80 * 5 * 27),
        (
            "strided conv, batch of two",
            "Conv",
            &[2, 3, 9, 9],
            &[4, 3, 3, 3],
            &[2, 4, 5, 5],
            vec![pads(), ("strides", ints(&[2, 2]))],
            2 * 25 * 4 * 27,
        ),
        (
            "depthwise conv",
            "Conv",
            &[1, 6, 7, 7],
            &[6, 1, 3, 3],
            &[1, 6, 7, 7],
            vec![pads(), ("group", Attribute::Int(6))],
            49 * 6 * 9,
        ),
        (
            "two groups, dilated, one-sided padding",
            "Conv",
            &[1, 4, 6, 6],
            &[8, 2, 3, 3],
            &[1, 8, 3, 3],
            vec![
                ("pads", ints(&[0, 0, 1, 1])),
                ("dilations", ints(&[2, 2])),
                ("group", Attribute::Int(2)),
            ],
            9 * 8 * 2 * 9,
        ),
        // Every input pixel of 4 channels goes to 3 channels of 2 x 2.
        (
            "transposed conv",
            "ConvTranspose",
            &[1, 4, 5, 5],
            &[4, 3, 2, 2],
            &[1, 3, 10, 10],
            vec![("strides", ints(&[2, 2]))],
            100 * 12,
        ),
        ("matrix", "MatMul", &[7, 16], &[16, 5], &[7, 5], vec![], 7 * 16 * 5),
        (
            "stack of matrices",
            "MatMul",
            &[2, 3, 7, 16],
            &[3, 16, 5],
            &[2, 3, 7, 5],
            vec![],
            6 * 560,
        ),
        (
            "gemm, first operand turned",
            "Gemm",
            &[16, 7],
            &[16, 5],
            &[7, 5],
            vec![("transA", Attribute::Int(1))],
            560,
        ),
        (
            "gemm, second operand turned",
            "Gemm",
            &[7, 16],
            &[5, 16],
            &[7, 5],
            vec![("transB", Attribute::Int(1))],
            560,
        ),
        ("sum", "Add", &[7, 16], &[16], &[7, 16], vec![], 0),
    ];
    for (name, op, x, w, out, attributes, want) in cases {
        let graph = graph(op, x, Some((w, floats(w))), out, attributes);
        assert_eq!(total(&graph), want, "{name}");
        assert_eq!(graph.nodes[0].multiplies(), want > 0, "{name}");
    }
}

#[test]
fn moves_keep_shapes_known() {
    type Case<'a> = (&'static str, &'a [usize], Option<&'a [i64]>, &'a [usize], Attributes);
    let axis = |a| vec![("axis", Attribute::Int(a))];
    let cases: Vec<Case<'_>> = vec![
        ("Reshape", &[2, 3, 4], Some(&[0, -1]), &[2, 12], vec![]),
        ("Expand", &[3, 1], Some(&[2, 1, 4]), &[2, 3, 4], vec![]),
        ("Tile", &[3, 2], Some(&[2, 5]), &[6, 10], vec![]),
        ("Transpose", &[2, 3, 4], None, &[4, 2, 3], vec![("perm", ints(&[2, 0, 1]))]),
        ("Concat", &[2, 3], None, &[2, 3], axis(-1)),
        ("Softmax", &[2, 3], None, &[2, 3], axis(-1)),
        ("ReduceSum", &[2, 3], Some(&[1]), &[2, 1], vec![]),
        ("ReduceMean", &[2, 3, 4], None, &[3], {
            vec![("axes", ints(&[0, -1])), ("keepdims", Attribute::Int(0))]
        }),
        ("Pad", &[2, 3], Some(&[0, 1, 2, 3]), &[4, 7], vec![]),
        ("Gather", &[5, 6], Some(&[1, 1, 4]), &[5, 3], axis(1)),
        ("MaxPool", &[1, 2, 9, 9], None, &[1, 2, 5, 5], {
            vec![
                ("kernel_shape", ints(&[3, 3])),
                ("strides", ints(&[2, 2])),
                ("pads", ints(&[1; 4])),
            ]
        }),
        ("AveragePool", &[1, 2, 6, 6], None, &[1, 2, 3, 3], {
            vec![
                ("kernel_shape", ints(&[3, 3])),
                ("strides", ints(&[2, 2])),
                ("ceil_mode", Attribute::Int(1)),
            ]
        }),
    ];
    for (op, x, constant, out, attributes) in cases {
        let constant = constant.map(|v| (vec![v.len()], Data::I64(v.to_vec())));
        let constant = constant.as_ref().map(|(dims, data)| (&dims[..], data.clone()));
        let graph = graph(op, x, constant, out, attributes);
        let file = model(&graph, Storage::Inline);
        let known = shapes::infer(file.graph.as_ref().unwrap()).unwrap();
        assert_eq!(known["layer/op"].dims, out, "{op}");
        assert!(!known["layer/op"].fixed, "{op}");
    }
}

/// `x[start:end:step]` for all that a slice can say.
#[test]
fn slices_have_the_length_that_python_gives_them() {
    for (start, end, step, want) in [
        (0, 7, 1, 7),
        (2, 5, 1, 3),
        (-3, i64::MAX, 1, 3),
        (1, 7, 3, 2),
        (6, 2, 1, 0),
        (-1, i64::MIN, -1, 7),
        (5, 1, -2, 2),
    ] {
        let mut graph = graph("Slice", &[4, 7], None, &[4, want], vec![]);
        for values in [start, end, 1, step] {
            let id = graph.add_constant("c", &[1], Data::I64(vec![values]));
            graph.nodes[0].inputs.push(Some(id));
        }
        let file = model(&graph, Storage::Inline);
        let known = shapes::infer(file.graph.as_ref().unwrap()).unwrap();
        assert_eq!(known["layer/op"].dims, [4, want], "{start}:{end}:{step}");
    }
}

#[test]
fn products_of_constants_cost_nothing() {
    let mut graph = graph("MatMul", &[2, 3], Some((&[3, 4], floats(&[3, 4]))), &[2, 4], vec![]);
    let a = graph.add_constant("a", &[3, 3], floats(&[3, 3]));
    let w = graph.nodes[0].input(1);
    let folded = graph.add_value("folded/MatMul", &[3, 4], Elem::F32);
    let constant =
        Node { op: "MatMul", inputs: vec![Some(a), w], output: folded, attributes: vec![] };
    graph.nodes.insert(0, constant);
    graph.nodes[1].inputs[1] = Some(folded);
    // The file's reader sees by itself that the inputs never change; the graph was told.
    assert_eq!(count_model(&model(&graph, Storage::Inline)).unwrap().len(), 1);
    graph.set_constant(folded, floats(&[3, 4]));
    assert_eq!(count(&graph).iter().map(|n| n.macs).sum::<u64>(), 24);
}

#[test]
fn what_cannot_be_counted_is_named() {
    let cases: [(&str, &[usize], &[usize]); 3] = [
        ("Frobnicate", &[2, 3], &[3, 4]),
        ("MatMul", &[2, 3], &[4, 4]),
        ("Conv", &[2, 3], &[3, 4]),
    ];
    for (op, x, w) in cases {
        let op: &'static str = op;
        let graph = graph(op, x, Some((w, floats(w))), &[2, 4], vec![]);
        let message = count_model(&model(&graph, Storage::Inline)).unwrap_err().to_string();
        for part in ["graph `g`", op, "layer/op", "[2, 3]"] {
            assert!(message.contains(part), "{part}: {message}");
        }
    }
    assert!(count_model(&ModelProto::default()).unwrap().is_empty());
    assert_eq!(layer("head.conv/MatMul_1"), "head.conv");
}
