//! Fixes the names of everything that is kept as text: JSON keys and words of rows, audits, ledgers, records and files.
//!
//! They are read from the source of each type that derives serde's traits, so that none is missed: a table by its name,
//! any other type, which no table leads to, as a block without its own name. Renaming a type changes nothing here.
//!
//! Invariant: a type whose text cannot be told from its source stands in one of the lists below, or the test fails.

use crate::serde_types::{Body, Serde, Shape, Type, Variant, close, parts, types};
use crate::source::{Name, Sources, crates, read_tokens};
use crate::{code, read, root};
use midshift_core::reason::Code;
use midshift_core::rows::Table;
use std::collections::{BTreeMap, BTreeSet};

/// The list of all of them.
pub const GOLDEN: &str = "tests/golden/stored_keys.txt";

/// Types of the standard library and of others that are one text, number or flag.
const PLAIN: [&str; 22] = [
    "String",
    "str",
    "char",
    "bool",
    "u8",
    "u16",
    "u32",
    "u64",
    "u128",
    "usize",
    "i8",
    "i16",
    "i32",
    "i64",
    "i128",
    "f32",
    "f64",
    "PathBuf",
    "SocketAddr",
    "IpAddr",
    "Value",
    "RawValue",
];
/// Types around another that leave no trace in the text.
const AROUND: [&str; 6] = ["Option", "Box", "Arc", "Rc", "Cow", "Spanned"];
/// Types of many.
const LISTS: [&str; 5] = ["Vec", "VecDeque", "BTreeSet", "HashSet", "Slice"];
const MAPS: [&str; 2] = ["BTreeMap", "HashMap"];

/// Types whose text is written by hand, or by the crate that they are of.
const BY_HAND: [&str; 2] = ["Map", "Table"];
/// Types that a macro makes: texts and numbers. The macros themselves are read like any other source.
const MADE: [&str; 16] = [
    "AreaId",
    "BundleId",
    "DrainId",
    "LinkDuration",
    "LinkTime",
    "PlaceId",
    "RequestId",
    "RobotId",
    "RolloutId",
    "SetId",
    "SiteDuration",
    "SiteId",
    "SiteTime",
    "StopId",
    "TaskId",
    "WaypointId",
];
/// Tables with rows of one type each, which a macro or a trait names, by the module of the type.
const MANY: &[(&str, &[Table])] = &[
    ("audit/chain", &[Table::TaskAudit, Table::FleetAudit, Table::OtaAudit, Table::StopAudit, Table::IdentityAudit]),
    ("leadership", &[Table::FleetLeader, Table::OtaLeader]),
    ("idempotency", &[Table::CommandKey, Table::OtaCommandKey]),
];

/// Words of a name in camel or snake case, in lower case.
fn words(name: &str) -> Vec<String> {
    let mut words = Vec::new();
    for part in name.split('_').filter(|part| !part.is_empty()) {
        for (n, c) in part.chars().enumerate() {
            if n == 0 || c.is_uppercase() {
                words.push(String::new());
            }
            words.last_mut().expect("a word").extend(c.to_lowercase());
        }
    }
    words
}

fn renamed(name: &str, rule: Option<&String>) -> String {
    let upper_first = |word: &String| word[..1].to_uppercase() + &word[1..];
    let words = words(name);
    match rule.map(String::as_str) {
        None => name.to_owned(),
        Some("snake_case") => words.join("_"),
        Some("SCREAMING_SNAKE_CASE") => words.join("_").to_uppercase(),
        Some("kebab-case") => words.join("-"),
        Some("lowercase") => words.concat(),
        Some("UPPERCASE") => words.concat().to_uppercase(),
        Some("PascalCase") => words.iter().map(upper_first).collect(),
        Some("camelCase") => words[0].clone() + &words[1..].iter().map(upper_first).collect::<String>(),
        Some(rule) => panic!("{rule} is not read here"),
    }
}

fn name_in_text(name: &str, own: &Serde, rule: Option<&String>) -> String {
    own.get("rename").cloned().unwrap_or_else(|| renamed(name, rule))
}

/// The path of a key below another.
fn join(prefix: &str, name: &str) -> String {
    if prefix.is_empty() { name.to_owned() } else { format!("{prefix}.{name}") }
}

/// Where a type is: library, module, name.
type Place = (String, Name, String);

/// Every type of the workspace that serde knows.
struct Types {
    crates: BTreeMap<String, Sources>,
    types: BTreeMap<Place, Type>,
}

/// What is found on the way through a type.
#[derive(Default)]
struct Found {
    lines: BTreeSet<String>,
    reached: BTreeSet<Place>,
    way: Vec<Place>,
}

impl Types {
    fn read() -> Self {
        let crates: BTreeMap<String, Sources> = crates()
            .into_iter()
            .map(|(library, folder)| (library.clone(), Sources::of_folder(&library, &folder)))
            .collect();
        let mut all = BTreeMap::new();
        for (library, sources) in &crates {
            for (module, path) in sources.modules() {
                for one in types(&read_tokens(&code(&read(path)))) {
                    all.insert((library.clone(), module.clone(), one.name.clone()), one);
                }
            }
        }
        Self { crates, types: all }
    }

    /// The type that a path of a file names.
    fn find(&self, (library, module, from): &Place, path: &[String]) -> Place {
        let name = path.last().expect("a name");
        let here = (library.clone(), module.clone(), name.clone());
        if path.len() == 1 && self.types.contains_key(&here) {
            return here;
        }
        let sources = &self.crates[library];
        let brought_in = sources.brought_in(module, &path[0]);
        let whole: Name = brought_in.map_or(path.to_vec(), |used| used.iter().chain(&path[1..]).cloned().collect());
        let name = whole.last().expect("a name").clone();
        let owner = match self.crates.get(&whole[0]).filter(|_| whole[0] != *library) {
            Some(other) => other
                .owner(&[], &["crate".to_owned()].iter().chain(&whole[1..]).cloned().collect::<Name>())
                .map(|module| (whole[0].clone(), module)),
            None => sources.owner(module, path).map(|module| (library.clone(), module)),
        };
        let owned = owner
            .map(|(library, module)| (library, module, name.clone()))
            .filter(|place| self.types.contains_key(place));
        owned.unwrap_or_else(|| {
            let is_alike = |place: &Place, one: &Type| {
                place.0 == *library && place.2 == name && !matches!(one.shape, Shape::Alias(_))
            };
            let mut alike = self.types.iter().filter(|(place, one)| is_alike(place, one));
            match (alike.next(), alike.next()) {
                (Some((one, _)), None) => one.clone(),
                _ => panic!("{path:?} in {from} of {library}::{module:?}: say above what it is as text"),
            }
        })
    }

    /// Adds what a type leaves in the text below `prefix`.
    fn follow(&self, at: &Place, ty: &[String], prefix: &str, found: &mut Found) {
        let ty: Vec<String> =
            ty.iter().filter(|token| !["&", "dyn", "'", "static"].contains(&token.as_str())).cloned().collect();
        if ty[0] == "(" {
            for (n, part) in parts(&ty[1..close(&ty, 0)]).into_iter().enumerate() {
                self.follow(at, part, &join(prefix, &n.to_string()), found);
            }
            return;
        }
        if ty[0] == "[" {
            let end = ty.iter().position(|token| token == ";").unwrap_or(ty.len() - 1);
            return self.follow(at, &ty[1..end], &format!("{prefix}[]"), found);
        }
        let open = ty.iter().position(|token| token == "<");
        let path: Name = ty[..open.unwrap_or(ty.len())].iter().filter(|token| *token != "::").cloned().collect();
        let arguments = open.map_or(Vec::new(), |open| parts(&ty[open + 1..close(&ty, open)]));
        let name = path.last().expect("a name").as_str();
        let parameters = self.types.get(at).map_or(&[][..], |one| &one.parameters);
        if AROUND.contains(&name) {
            self.follow(at, arguments[arguments.len() - 1], prefix, found);
        } else if LISTS.contains(&name) {
            self.follow(at, arguments[0], &format!("{prefix}[]"), found);
        } else if MAPS.contains(&name) {
            self.follow(at, arguments[0], &format!("{prefix}{{key}}"), found);
            self.follow(at, arguments[1], &format!("{prefix}{{}}"), found);
        } else if [&PLAIN[..], &BY_HAND, &MADE].iter().any(|known| known.contains(&name)) {
            found.lines.insert(prefix.to_owned());
        } else if parameters.iter().any(|parameter| parameter == name) {
            found.lines.insert(format!("{prefix}<{name}>"));
        } else {
            self.enter(&self.find(at, &path), prefix, found);
        }
    }

    fn enter(&self, place: &Place, prefix: &str, found: &mut Found) {
        found.reached.insert(place.clone());
        if found.way.contains(place) {
            found.lines.insert(format!("{prefix} …"));
            return;
        }
        found.way.push(place.clone());
        let one = &self.types[place];
        let other = ["into", "from", "try_from"].iter().find_map(|word| one.serde.get(*word));
        match (&one.shape, other) {
            (_, Some(other)) => self.follow(place, &read_tokens(other), prefix, found),
            (Shape::Alias(ty), _) => self.follow(place, ty, prefix, found),
            (Shape::Struct(body), _) => self.body(place, body, one.serde.get("rename_all"), prefix, found),
            (Shape::Enum(variants), _) => self.variants(place, one, variants, prefix, found),
            (Shape::OfMacro, _) => drop(found.lines.insert(format!("{prefix} = …"))),
        }
        found.way.pop();
    }

    fn body(&self, at: &Place, body: &Body, rule: Option<&String>, prefix: &str, found: &mut Found) {
        let (Body::Named(fields) | Body::Tuple(fields)) = body;
        let is_one = matches!(body, Body::Tuple(_)) && fields.len() == 1;
        if fields.is_empty() {
            found.lines.insert(prefix.to_owned());
        }
        for field in fields.iter().filter(|field| !field.serde.contains_key("skip")) {
            let name = name_in_text(&field.name, &field.serde, rule);
            let is_level = !is_one && !field.serde.contains_key("flatten");
            let below = if is_level { join(prefix, &name) } else { prefix.to_owned() };
            let by_hand =
                ["with", "serialize_with", "deserialize_with"].iter().any(|word| field.serde.contains_key(*word));
            match by_hand {
                true => drop(found.lines.insert(below)),
                false => self.follow(at, &field.ty, &below, found),
            }
        }
    }

    fn variants(&self, at: &Place, one: &Type, variants: &[Variant], prefix: &str, found: &mut Found) {
        let mut plain = Vec::new();
        for variant in variants.iter().filter(|variant| !variant.serde.contains_key("skip")) {
            let name = name_in_text(&variant.name, &variant.serde, one.serde.get("rename_all"));
            let rule = variant.serde.get("rename_all").or(one.serde.get("rename_all_fields"));
            let is_untagged = one.serde.contains_key("untagged") || variant.serde.contains_key("untagged");
            let (Body::Named(fields) | Body::Tuple(fields)) = &variant.body;
            let inner = match one.serde.get("tag") {
                Some(tag) => {
                    found.lines.insert(format!("{} = {name}", join(prefix, tag)));
                    one.serde.get("content").map_or(prefix.to_owned(), |content| join(prefix, content))
                }
                None if is_untagged => prefix.to_owned(),
                None if fields.is_empty() => {
                    plain.push(name);
                    continue;
                }
                None => join(prefix, &name),
            };
            if !fields.is_empty() {
                self.body(at, &variant.body, rule, &inner, found);
            }
        }
        if !plain.is_empty() {
            found.lines.insert(format!("{prefix} = {}", plain.join(" | ")));
        }
    }

    /// What one type leaves in the text, and which types it is made of.
    fn text(&self, place: &Place) -> Found {
        let mut found = Found::default();
        self.enter(place, "", &mut found);
        found
    }
}

impl Types {
    /// Types that implement one of the two traits, with the table that the first constant in them names, if it names one.
    fn tables_by(&self, implemented: &str) -> Vec<(Option<String>, Place)> {
        let mut found = Vec::new();
        for (library, sources) in &self.crates {
            for (module, path) in sources.modules() {
                let tokens = read_tokens(&code(&read(path)));
                for at in (0..tokens.len())
                    .filter(|at| tokens[*at] == implemented && tokens.get(at + 1).is_some_and(|t| t == "for"))
                {
                    let name =
                        if tokens[at + 2] == "$" { format!("${}", tokens[at + 3]) } else { tokens[at + 2].clone() };
                    let end = at + tokens[at..].iter().position(|token| token == ";").expect("a constant");
                    let table = Some(tokens[end - 1].clone()).filter(|_| tokens[end - 3] == "Table");
                    found.push((table, self.find(&(library.clone(), module.clone(), String::new()), &[name])));
                }
            }
        }
        found
    }

    /// The type of the rows of each table.
    fn tables(&self) -> BTreeMap<Table, Place> {
        let mut rows = BTreeMap::new();
        let mut insert = |table: Table, place: &Place| {
            let twice = rows.insert(table, place.clone());
            assert!(twice.is_none(), "{table:?} has rows of {place:?} and of {twice:?}");
        };
        for (table, place) in self.tables_by("Record") {
            match table {
                Some(name) => insert(*Table::ALL.iter().find(|t| format!("{t:?}") == name).expect("a table"), &place),
                None => {
                    let many = MANY.iter().find(|(module, _)| place.1.join("/") == *module);
                    let (_, tables) = many.unwrap_or_else(|| panic!("say in MANY which tables have rows of {place:?}"));
                    tables.iter().for_each(|table| insert(*table, &place));
                }
            }
        }
        rows
    }
}

/// Keys of each object that a file writes by hand.
fn objects(tokens: &[String]) -> BTreeSet<String> {
    let calls =
        (0..tokens.len()).filter(|at| tokens[*at] == "json" && tokens[at + 1..].starts_with(&["!".into(), "(".into()]));
    let keys = |at: usize| {
        let inner = &tokens[at + 2..close(tokens, at + 2)];
        let named = inner.windows(2).filter(|pair| pair[0].starts_with('"') && pair[1] == ":");
        named.map(|pair| pair[0][1..].to_owned()).collect::<BTreeSet<_>>().into_iter().collect::<Vec<_>>().join(" ")
    };
    calls.map(keys).filter(|keys| !keys.is_empty()).collect()
}

fn block(head: &str, lines: &BTreeSet<String>) -> String {
    lines.iter().fold(head.to_owned(), |text, line| text + "\n    " + line) + "\n"
}

/// All names in what is kept as text, a block a table or type.
fn kept() -> String {
    let types = Types::read();
    let commands = types.tables_by("IdempotentRequest");
    let mut reached = BTreeSet::new();
    let mut blocks = Vec::new();
    let rows = types.tables();
    for table in Table::ALL {
        let place = rows.get(table).unwrap_or_else(|| panic!("no type has the rows of {table:?}"));
        let mut found = types.text(place);
        if let Some((_, command)) = commands.iter().find(|(of, _)| of.as_deref() == Some(format!("{table:?}").as_str()))
        {
            assert!(found.lines.remove("command<C>"), "{:?}", found.lines);
            types.enter(command, "command", &mut found);
        }
        blocks.push(block(&format!("table {}", table.name()), &found.lines));
        reached.extend(found.reached);
    }
    let others =
        types.types.iter().filter(|(place, one)| !reached.contains(*place) && !matches!(one.shape, Shape::Alias(_)));
    let others: Vec<(&Place, Found)> = others.map(|(place, _)| (place, types.text(place))).collect();
    let is_part = |place: &Place| others.iter().any(|(other, found)| *other != place && found.reached.contains(place));
    let mut tops: Vec<String> = others
        .iter()
        .filter(|(place, _)| !is_part(place))
        .map(|((library, ..), found)| block(library, &found.lines))
        .collect();
    tops.sort();
    blocks.extend(tops);
    for (library, sources) in &types.crates {
        let lines: BTreeSet<String> =
            sources.modules().flat_map(|(_, path)| objects(&read_tokens(&code(&read(path))))).collect();
        if !lines.is_empty() {
            blocks.push(block(&format!("{library}, objects by hand"), &lines));
        }
    }
    blocks.push(block("reason codes", &Code::ALL.iter().map(|code| code.as_str().to_owned()).collect()));
    blocks.join("\n")
}

#[test]
fn golden_names_in_what_is_kept_stay() {
    let kept = kept();
    let path = root().join(GOLDEN);
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, &kept).expect("written");
    }
    let golden = std::fs::read_to_string(&path).unwrap_or_default();
    let (now, before): (BTreeSet<&str>, BTreeSet<&str>) = (kept.lines().collect(), golden.lines().collect());
    let (came, left): (Vec<_>, Vec<_>) = (now.difference(&before).collect(), before.difference(&now).collect());
    assert!(
        kept == golden,
        "if it is meant, run with BLESS=1 and list it in CHANGELOG.md: came {came:#?}, left {left:#?}"
    );
}

#[test]
fn a_name_in_a_text_is_read_however_its_type_says_it() {
    let of = |text: &str| {
        let sources = Sources::new("small", "src", [("src/lib.rs".to_owned(), text.to_owned())]);
        let all =
            types(&read_tokens(text)).into_iter().map(|one| (("small".to_owned(), Name::new(), one.name.clone()), one));
        let types = Types { types: all.collect(), crates: BTreeMap::from([("small".to_owned(), sources)]) };
        types.text(&("small".to_owned(), Name::new(), "A".to_owned())).lines.into_iter().collect::<Vec<_>>()
    };
    let derive = "#[derive(Clone, Serialize)]";
    let inner = format!("{derive} struct B {{ c: u8, #[serde(skip)] d: D }}");
    for (fields, lines) in [
        ("struct A { pub(crate) b: Option<B> }", vec!["b.c"]),
        ("struct A { #[serde(rename = \"x\")] b: Vec<B>, #[serde(flatten)] e: B }", vec!["c", "x[].c"]),
        ("struct A(BTreeMap<String, Box<B>>);", vec!["{key}", "{}.c"]),
        ("#[serde(rename_all = \"camelCase\")] struct A { a_b: (u8, B) }", vec!["aB.0", "aB.1.c"]),
        ("#[serde(rename_all = \"SCREAMING_SNAKE_CASE\")] enum A { OneTwo, Three = 3 }", vec![" = ONE_TWO | THREE"]),
        ("enum A { One(B), Two { b: [B; 2] }, Three }", vec![" = Three", "One.c", "Two.b[].c"]),
        ("#[serde(tag = \"t\")] enum A { One { b: u8 } }", vec!["b", "t = One"]),
        ("#[serde(from = \"B\", into = \"B\")] struct A { z: Z }", vec!["c"]),
        ("struct A { again: Option<Box<A>> }", vec!["again …"]),
    ] {
        assert_eq!(of(&format!("{inner}\n{derive}\n{fields}")), lines, "{fields}");
    }
    assert_eq!(
        of(&format!("type B = Vec<C>; {derive} struct C {{ d: &'static str }} {derive} struct A {{ b: B }}")),
        ["b[].d"]
    );
}
