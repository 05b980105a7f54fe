// A peer on the message classes of openigtlink-rust that sends what its standard input has and prints what it receives:
// see foreign_peers.py.  Of a server they have metadata, with which that crate writes header version 3.

use std::fmt::Write as _;
use std::io::{BufRead, Read, Write};
use std::net::{TcpListener, TcpStream};

use openigtlink_rust::protocol::message::{IgtlMessage, Message};
use openigtlink_rust::protocol::types::capability::CapabilityMessage;
use openigtlink_rust::protocol::types::image::{CoordinateSystem, Endian, ImageMessage, ImageScalarType};
use openigtlink_rust::protocol::types::ndarray::{NdArrayMessage, ScalarType};
use openigtlink_rust::protocol::types::point::{PointElement, PointMessage};
use openigtlink_rust::protocol::types::position::PositionMessage;
use openigtlink_rust::protocol::types::sensor::SensorMessage;
use openigtlink_rust::protocol::types::status::StatusMessage;
use openigtlink_rust::protocol::types::string::StringMessage;
use openigtlink_rust::protocol::types::tdata::{TDataMessage, TrackingDataElement, TrackingInstrumentType};
use openigtlink_rust::protocol::types::transform::TransformMessage;

type Failure = Box<dyn std::error::Error>;

fn main() {
    let words: Vec<String> = std::env::args().collect();
    let mut link = if words[1] == "client" {
        TcpStream::connect(format!("{}:{}", words[2], words[3])).unwrap()
    } else {
        let listener = TcpListener::bind(format!("127.0.0.1:{}", words[2])).unwrap();
        println!("ready");
        listener.accept().unwrap().0
    };
    println!("ready");
    let reading = link.try_clone().unwrap();
    std::thread::spawn(move || receive(reading));
    for line in std::io::stdin().lock().lines() {
        let line = line.unwrap();
        let words: Vec<&str> = line.split(' ').collect();
        match made(&words) {
            Ok(data) => link.write_all(&data).unwrap(),
            Err(error) => println!("error {}", quoted(&error.to_string())),
        }
    }
}

// words: type, device, stamp in ns, then those of the content

fn made(words: &[&str]) -> Result<Vec<u8>, Failure> {
    let rest = &words[3..];
    match words[0] {
        "TRANSFORM" => packed(words, TransformMessage { matrix: four(&columns(rest)?) }),
        "POSITION" => {
            let v = floats(rest)?;
            packed(words, PositionMessage::with_quaternion([v[0], v[1], v[2]], [v[3], v[4], v[5], v[6]]))
        }
        "STRING" => packed(words, StringMessage::utf8(text(rest[0]))),
        "STATUS" => packed(
            words,
            StatusMessage { code: rest[0].parse()?, subcode: rest[1].parse()?, error_name: text(rest[2]), status_string: text(rest[3]) },
        ),
        "IMAGE" => {
            let size = [rest[0].parse()?, rest[1].parse()?, rest[2].parse()?];
            let scalar = ImageScalarType::from_u8(rest[3].parse()?)?;
            let data = bytes(rest[19])?;
            let mut image = if rest[4] == "3" { ImageMessage::rgb(scalar, size, data)? } else { ImageMessage::new(scalar, size, data)? };
            image.endian = Endian::from_u8(rest[5].parse()?)?;
            packed(words, image.with_matrix(columns(&rest[7..19])?).with_coordinate(CoordinateSystem::RAS))
        }
        "SENSOR" => packed(words, SensorMessage::new(rest[1..].iter().map(|word| word.parse()).collect::<Result<_, _>>()?)?),
        "NDARRAY" => {
            let data: Vec<u8> = floats(&rest[2..])?.iter().flat_map(|value| value.to_be_bytes()).collect();
            packed(words, NdArrayMessage::new_1d(ScalarType::Float32, data)?)
        }
        "POINT" => {
            let mut points = Vec::new();
            for one in rest.chunks(11) {
                let place = floats(&one[6..9])?;
                let rgba = [one[2].parse()?, one[3].parse()?, one[4].parse()?, one[5].parse()?];
                points.push(PointElement::with_details(text(one[0]), text(one[1]), rgba, [place[0], place[1], place[2]], one[9].parse()?, text(one[10])));
            }
            packed(words, PointMessage::new(points))
        }
        "TDATA" => {
            let mut tools = Vec::new();
            for one in rest.chunks(14) {
                let kind = match one[1] {
                    "1" => TrackingInstrumentType::Tracker,
                    "2" => TrackingInstrumentType::Instrument6D,
                    "3" => TrackingInstrumentType::Instrument3D,
                    _ => TrackingInstrumentType::Instrument5D,
                };
                tools.push(TrackingDataElement::new(text(one[0]), kind, columns(&one[2..14])?));
            }
            packed(words, TDataMessage::new(tools))
        }
        "CAPABILITY" => packed(words, CapabilityMessage::new(rest.iter().map(|word| text(word)).collect())),
        kind => Err(format!("no class for {kind}").into()),
    }
}

fn packed<T: Message>(words: &[&str], content: T) -> Result<Vec<u8>, Failure> {
    let mut message = IgtlMessage::new(content, &text(words[1]))?;
    let stamp_ns: u64 = words[2].parse()?;
    message.header.timestamp.seconds = (stamp_ns / 1_000_000_000) as u32;
    message.header.timestamp.fraction = (((stamp_ns % 1_000_000_000) << 32) / 1_000_000_000) as u32;
    if std::env::args().nth(1).as_deref() == Some("server") {
        message.add_metadata("operator".to_string(), "A. B.".to_string());
    }
    Ok(message.encode()?)
}

fn receive(mut link: TcpStream) {
    let mut head = [0u8; 58];
    while link.read_exact(&mut head).is_ok() {
        let size = u64::from_be_bytes(head[42..50].try_into().unwrap()) as usize;
        let mut data = head.to_vec();
        data.resize(58 + size, 0);
        if link.read_exact(&mut data[58..]).is_err() {
            return;
        }
        let kind = name(&head[2..14]);
        let seconds = u32::from_be_bytes(head[34..38].try_into().unwrap());
        let fraction = u32::from_be_bytes(head[38..42].try_into().unwrap());
        let begin = format!("{} {} {} {} {}", kind, quoted(&name(&head[14..34])), seconds, fraction, head[1]);
        // what it cannot read is a result, also where it ends with a panic
        match std::panic::catch_unwind(|| shown(&kind, &data).map_err(|error| error.to_string())) {
            Ok(Ok(words)) => println!("{begin}{words}"),
            Ok(Err(error)) => println!("error {}", quoted(&format!("{kind}: {error}"))),
            Err(_) => println!("error {}", quoted(&format!("{kind}: a panic"))),
        }
    }
}

fn shown(kind: &str, data: &[u8]) -> Result<String, Failure> {
    let mut words = String::new();
    match kind {
        "TRANSFORM" => {
            let got = IgtlMessage::<TransformMessage>::decode(data)?.content.matrix;
            (0..4).for_each(|column| (0..3).for_each(|row| write!(words, " {}", got[row][column]).unwrap()));
        }
        "POSITION" => {
            let got = IgtlMessage::<PositionMessage>::decode(data)?.content;
            got.position.iter().chain(&got.quaternion).for_each(|value| write!(words, " {value}").unwrap());
        }
        "STRING" => write!(words, " {}", quoted(&IgtlMessage::<StringMessage>::decode(data)?.content.string))?,
        "STATUS" => {
            let got = IgtlMessage::<StatusMessage>::decode(data)?.content;
            write!(words, " {} {} {} {}", got.code, got.subcode, quoted(&got.error_name), quoted(&got.status_string))?;
        }
        "IMAGE" => {
            let got = IgtlMessage::<ImageMessage>::decode(data)?.content;
            write!(words, " {} {} {} {} {} {} {}", got.size[0], got.size[1], got.size[2], got.scalar_type as u8, got.num_components, got.endian as u8, got.coordinate as u8)?;
            (0..4).for_each(|column| (0..3).for_each(|row| write!(words, " {}", got.matrix[row][column]).unwrap()));
            words.push_str(" =");
            got.data.iter().for_each(|byte| write!(words, "{byte:02x}").unwrap());
        }
        "SENSOR" => IgtlMessage::<SensorMessage>::decode(data)?.content.data.iter().for_each(|value| write!(words, " {value}").unwrap()),
        "POINT" => {
            let got = IgtlMessage::<PointMessage>::decode(data)?.content.points;
            write!(words, " {}", got.len())?;
            got.iter().flat_map(|point| point.position).for_each(|value| write!(words, " {value}").unwrap());
        }
        "TDATA" => {
            for tool in IgtlMessage::<TDataMessage>::decode(data)?.content.elements {
                write!(words, " {} {}", quoted(&tool.name), tool.instrument_type as u8)?;
                (0..4).for_each(|column| (0..3).for_each(|row| write!(words, " {}", tool.matrix[row][column]).unwrap()));
            }
        }
        "CAPABILITY" => IgtlMessage::<CapabilityMessage>::decode(data)?.content.types.iter().for_each(|one| write!(words, " {}", quoted(one)).unwrap()),
        _ => {}
    }
    Ok(words)
}

fn floats(words: &[&str]) -> Result<Vec<f32>, Failure> {
    Ok(words.iter().map(|word| word.parse()).collect::<Result<_, _>>()?)
}

fn columns(words: &[&str]) -> Result<[[f32; 4]; 3], Failure> {
    let values = floats(&words[..12])?;
    let mut rows = [[0.0; 4]; 3];
    for (at, value) in values.iter().enumerate() {
        rows[at % 3][at / 3] = *value;
    }
    Ok(rows)
}

fn four(rows: &[[f32; 4]; 3]) -> [[f32; 4]; 4] {
    [rows[0], rows[1], rows[2], [0.0, 0.0, 0.0, 1.0]]
}

fn bytes(word: &str) -> Result<Vec<u8>, Failure> {
    (1..word.len()).step_by(2).map(|at| Ok(u8::from_str_radix(&word[at..at + 2], 16)?)).collect()
}

fn name(field: &[u8]) -> String {
    String::from_utf8_lossy(field.split(|byte| *byte == 0).next().unwrap()).into_owned()
}

fn text(word: &str) -> String {
    let (mut found, data) = (Vec::new(), word.as_bytes());
    let mut at = 1;
    while at < data.len() {
        if data[at] == b'%' {
            found.push(u8::from_str_radix(&word[at + 1..at + 3], 16).unwrap());
            at += 3;
        } else {
            found.push(data[at]);
            at += 1;
        }
    }
    String::from_utf8(found).unwrap()
}

fn quoted(text: &str) -> String {
    let mut found = String::from("=");
    for byte in text.bytes() {
        if byte.is_ascii_alphanumeric() || b"-_.".contains(&byte) {
            found.push(byte as char);
        } else {
            write!(found, "%{byte:02X}").unwrap();
        }
    }
    found
}
