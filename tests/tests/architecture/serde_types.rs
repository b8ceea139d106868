//! Types that derive serde's traits, as their source says: fields, variants, and what stands in `serde(…)`.

use crate::source::is_word;
use std::collections::BTreeMap;

/// What stands in `serde(…)`.
pub type Serde = BTreeMap<String, String>;

pub struct Field {
    pub name: String,
    pub serde: Serde,
    pub ty: Vec<String>,
}

pub struct Variant {
    pub name: String,
    pub serde: Serde,
    pub body: Body,
}

pub enum Body {
    Named(Vec<Field>),
    Tuple(Vec<Field>),
}

pub enum Shape {
    Struct(Body),
    Enum(Vec<Variant>),
    Alias(Vec<String>),
    /// An enum whose variants a macro is given.
    OfMacro,
}

pub struct Type {
    pub name: String,
    pub parameters: Vec<String>,
    pub serde: Serde,
    pub shape: Shape,
}

/// Index of the bracket that closes the one at `open`.
pub fn close(tokens: &[String], open: usize) -> usize {
    let (begin, end) = match tokens[open].as_str() {
        "(" => ("(", ")"),
        "[" => ("[", "]"),
        "{" => ("{", "}"),
        _ => ("<", ">"),
    };
    let mut depth = 0;
    for (at, token) in tokens.iter().enumerate().skip(open) {
        depth += i32::from(token == begin) - i32::from(token == end);
        if depth == 0 {
            return at;
        }
    }
    panic!("nothing closes {:?}", &tokens[open..tokens.len().min(open + 8)]);
}

/// Parts between commas that stand in no bracket.
pub fn parts(tokens: &[String]) -> Vec<&[String]> {
    let (mut depth, mut begin, mut found) = (0, 0, Vec::new());
    for (at, token) in tokens.iter().enumerate() {
        match token.as_str() {
            "(" | "[" | "{" | "<" => depth += 1,
            ")" | "]" | "}" | ">" => depth -= 1,
            "," if depth == 0 => {
                found.push(&tokens[begin..at]);
                begin = at + 1;
            }
            _ => {}
        }
    }
    found.push(&tokens[begin..]);
    found.into_iter().filter(|part| !part.is_empty()).collect()
}

/// What stands in `serde(…)` of the attributes that a part begins with, and the rest of it without its visibility.
fn attributes(mut part: &[String]) -> (Serde, &[String]) {
    let mut serde = Serde::new();
    loop {
        match part {
            [hash, open, ..] if hash == "#" && open == "[" => {
                let end = close(part, 1);
                if part[2] == "serde" {
                    for one in parts(&part[4..end - 1]) {
                        let value = one.get(2).map(|value| value.trim_start_matches('"').to_owned());
                        serde.insert(one[0].clone(), value.unwrap_or_default());
                    }
                }
                part = &part[end + 1..];
            }
            [public, open, ..] if public == "pub" && open == "(" => part = &part[close(part, 1) + 1..],
            [public, ..] if public == "pub" => part = &part[1..],
            _ => return (serde, part),
        }
    }
}

fn body_of(tokens: &[String]) -> Body {
    let inner = if tokens.is_empty() { tokens } else { &tokens[1..close(tokens, 0)] };
    let fields = parts(inner).into_iter().map(attributes);
    if tokens.first().is_some_and(|open| open == "{") {
        Body::Named(
            fields.map(|(serde, rest)| Field { name: rest[0].clone(), serde, ty: rest[2..].to_vec() }).collect(),
        )
    } else {
        let numbered = fields.enumerate();
        Body::Tuple(numbered.map(|(n, (serde, ty))| Field { name: n.to_string(), serde, ty: ty.to_vec() }).collect())
    }
}

fn variants_of(tokens: &[String]) -> Shape {
    let mut variants = Vec::new();
    for part in parts(tokens) {
        let (serde, rest) = attributes(part);
        if rest[0] == "$" {
            return Shape::OfMacro;
        }
        let body = rest.get(1..).filter(|body| body.first().is_some_and(|first| first != "="));
        variants.push(Variant { name: rest[0].clone(), serde, body: body_of(body.unwrap_or_default()) });
    }
    Shape::Enum(variants)
}

/// Types of a file that serde writes or reads, and its other names of types.
pub fn types(tokens: &[String]) -> Vec<Type> {
    let (mut at, mut begin, mut derives, mut found) = (0, 0, false, Vec::new());
    while at < tokens.len() {
        let next = tokens.get(at + 1).map_or("", String::as_str);
        match (tokens[at].as_str(), next) {
            ("#", "[") => {
                let end = close(tokens, at + 1);
                derives |= tokens[at + 2] == "derive"
                    && tokens[at..end].iter().any(|t| t == "Serialize" || t == "Deserialize");
                at = end + 1;
            }
            ("pub", "(") => at = close(tokens, at + 1) + 1,
            ("pub", _) => at += 1,
            ("struct" | "enum", _) if derives => {
                let (serde, _) = attributes(&tokens[begin..]);
                let is_enum = tokens[at] == "enum";
                at += 1 + usize::from(next == "$");
                let name = if next == "$" { format!("${}", tokens[at]) } else { next.to_owned() };
                at += 1;
                let mut parameters = Vec::new();
                if tokens[at] == "<" {
                    let end = close(tokens, at);
                    parameters.extend(tokens[at + 1..end].iter().filter(|t| is_word(t)).cloned());
                    at = end + 1;
                }
                let open =
                    at + tokens[at..].iter().position(|t| ["{", "(", ";"].contains(&t.as_str())).expect("a body");
                let end = if tokens[open] == ";" { open } else { close(tokens, open) };
                let shape = match is_enum {
                    true => variants_of(&tokens[open + 1..end]),
                    false if tokens[open] == ";" => Shape::Struct(body_of(&[])),
                    false => Shape::Struct(body_of(&tokens[open..=end])),
                };
                found.push(Type { name, parameters, serde, shape });
                (at, begin, derives) = (end + 1, end + 1, false);
            }
            ("type", name) if is_word(name) && tokens.get(at + 2).is_some_and(|t| t == "=") => {
                let end = at + tokens[at..].iter().position(|t| t == ";").expect("an end");
                let shape = Shape::Alias(tokens[at + 3..end].to_vec());
                found.push(Type { name: name.to_owned(), parameters: Vec::new(), serde: Serde::new(), shape });
                (at, begin, derives) = (end + 1, end + 1, false);
            }
            _ => {
                at += 1;
                (begin, derives) = (at, false);
            }
        }
    }
    found
}
