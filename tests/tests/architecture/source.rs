//! Reads Rust source as tokens, the paths that a file names, and the file that owns each of them.
//!
//! Inline tests and folders of tests are left out. A name that a `mod.rs` passes on counts for the file that owns it.

use crate::{code, files, read};
use std::collections::{BTreeMap, BTreeSet};

/// Names from the root of the crate on.
pub type Name = Vec<String>;

/// Files by the files that they use.
pub type Arrows = BTreeMap<String, BTreeSet<String>>;

/// How many names that are passed on are followed one after the other.
const PASSED_ON_MAX: usize = 8;

/// A raw string behind its `r`, with a quote before it, and its length in the source.
fn raw_string(chars: &[char]) -> Option<(String, usize)> {
    let hashes = chars.iter().take_while(|c| **c == '#').count();
    let text = chars.get(hashes + 1..).filter(|_| chars[hashes] == '"')?;
    let end: Vec<char> = ['"'].into_iter().chain(vec!['#'; hashes]).collect();
    let length = text.windows(end.len()).position(|at| at == end)?;
    Some((['"'].iter().chain(&text[..length]).collect(), hashes + 1 + length + end.len()))
}

/// Words of code: names, `::`, single signs, and strings with a quote before them. Characters and comments are left out.
pub fn read_tokens(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let (mut at, mut found) = (0, Vec::new());
    while at < chars.len() {
        let next = chars.get(at + 1).copied().unwrap_or(' ');
        match chars[at] {
            '/' if next == '/' => {
                while at < chars.len() && chars[at] != '\n' {
                    at += 1;
                }
            }
            '"' => {
                let begin = at;
                at += 1;
                while at < chars.len() && chars[at] != '"' {
                    at += if chars[at] == '\\' { 2 } else { 1 };
                }
                found.push(chars[begin..at.min(chars.len())].iter().collect());
                at += 1;
            }
            '\'' if next == '\\' || chars.get(at + 2) == Some(&'\'') => {
                at += 2 + usize::from(next == '\\');
                while at < chars.len() && chars[at] != '\'' {
                    at += 1;
                }
                at += 1;
            }
            ':' if next == ':' => {
                found.push("::".to_owned());
                at += 2;
            }
            c if c.is_alphanumeric() || c == '_' => {
                let word: String = chars[at..].iter().take_while(|c| c.is_alphanumeric() || **c == '_').collect();
                at += word.chars().count();
                match raw_string(&chars[at..]).filter(|_| word == "r" || word == "br") {
                    Some((raw, length)) => {
                        found.push(raw);
                        at += length;
                    }
                    None => found.push(word),
                }
            }
            c => {
                if !c.is_whitespace() {
                    found.push(c.to_string());
                }
                at += 1;
            }
        }
    }
    found
}

pub fn is_word(token: &str) -> bool {
    token == "*" || token.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// Paths of the tree of a `use`, each with the name that it has here.
fn leaves(tree: &[String], prefix: &[String], found: &mut Vec<(Name, String)>) {
    let (mut depth, mut begin) = (0_usize, 0);
    for at in 0..=tree.len() {
        match tree.get(at).map(String::as_str) {
            Some("{") => depth += 1,
            Some("}") => depth -= 1,
            Some(",") | None if depth == 0 => {
                leaf(&tree[begin..at], prefix, found);
                begin = at + 1;
            }
            _ => {}
        }
    }
}

fn leaf(tree: &[String], prefix: &[String], found: &mut Vec<(Name, String)>) {
    let path = tree.iter().take_while(|token| is_word(token) && *token != "as" || *token == "::");
    let mut name: Name = prefix.to_vec();
    name.extend(path.filter(|token| *token != "::").cloned());
    if let Some(open) = tree.iter().position(|token| token == "{") {
        return leaves(&tree[open + 1..tree.len() - 1], &name, found);
    }
    if name.last().is_some_and(|last| last == "self") {
        name.pop();
    }
    let alias = tree.iter().position(|token| token == "as").and_then(|at| tree.get(at + 1)).or(name.last()).cloned();
    if let Some(alias) = alias.filter(|_| !tree.is_empty()) {
        found.push((name, alias));
    }
}

/// What one file names.
#[derive(Default)]
struct Named {
    /// Paths that it brings in, each with its name here, and whether it passes it on.
    uses: Vec<(Name, String, bool)>,
    /// Paths in its code.
    paths: Vec<Name>,
}

/// A path of an inline module as the file names it: each `super` that leads out of such a module is left out.
fn from_file(path: Name, inline: usize) -> Name {
    let above = path.iter().take_while(|name| *name == "super").count();
    match above {
        _ if inline == 0 => path,
        0 if path.first().is_some_and(|first| first == "self") => vec!["self".to_owned()],
        0 => path,
        _ if above > inline => path[inline..].to_vec(),
        _ if above == inline => ["self".to_owned()].into_iter().chain(path[above..].iter().cloned()).collect(),
        _ => vec!["self".to_owned()],
    }
}

fn named(text: &str) -> Named {
    let tokens = read_tokens(text);
    let (mut at, mut named) = (0, Named::default());
    // Brackets that are open, and how many were open where each inline module begins.
    let (mut depth, mut inline) = (0_usize, Vec::new());
    while at < tokens.len() {
        match tokens[at].as_str() {
            "{" => depth += 1,
            "}" => {
                depth = depth.saturating_sub(1);
                inline.pop_if(|begin| *begin == depth);
            }
            "mod" if tokens.get(at + 2).is_some_and(|open| open == "{") => inline.push(depth),
            _ => {}
        }
        let is_in = tokens[at] == "in" && at > 1 && tokens[at - 1] == "(" && tokens[at - 2] == "pub";
        if tokens[at] == "use" && tokens.get(at + 1).is_some_and(|next| is_word(next)) {
            let end = tokens[at..].iter().position(|token| token == ";").map_or(tokens.len(), |end| at + end);
            let mut found = Vec::new();
            leaves(&tokens[at + 1..end], &[], &mut found);
            let is_passed_on = at > 0 && matches!(tokens[at - 1].as_str(), "pub" | ")");
            let of_file = |(name, alias)| (from_file(name, inline.len()), alias, is_passed_on);
            named.uses.extend(found.into_iter().map(of_file));
            at = end;
        } else if is_in || is_word(&tokens[at]) && tokens[at] != "*" {
            let begin = if is_in { at + 1 } else { at };
            let mut path = vec![tokens[begin].clone()];
            at = begin;
            while tokens.get(at + 1).is_some_and(|token| token == "::")
                && tokens.get(at + 2).is_some_and(|token| is_word(token))
            {
                path.push(tokens[at + 2].clone());
                at += 2;
            }
            if path.len() > 1 && !is_in {
                named.paths.push(from_file(path, inline.len()));
            }
        }
        at += 1;
    }
    named
}

/// The files of a crate by their modules.
pub struct Sources {
    /// Name of its library in paths; of a program without one: nothing that a path could name.
    library: String,
    files: BTreeMap<Name, (String, Named)>,
}

impl Sources {
    /// Reads texts by their paths, which begin with `root`. The library of the crate has the name `library` in paths.
    pub fn new(library: &str, root: &str, texts: impl IntoIterator<Item = (String, String)>) -> Self {
        let texts: BTreeMap<String, String> = texts.into_iter().collect();
        let top = if texts.contains_key(&format!("{root}/lib.rs")) { "lib" } else { "main" };
        let module = |path: &str| -> Name {
            let short = path.trim_start_matches(root).trim_start_matches('/').trim_end_matches(".rs");
            short.split('/').filter(|name| *name != "mod" && *name != top).map(str::to_owned).collect()
        };
        let files = texts.into_iter().map(|(path, text)| (module(&path), (path, named(&code(&text)))));
        Self { library: library.to_owned(), files: files.collect() }
    }

    /// Reads the files below a folder.
    pub fn of_folder(library: &str, root: &str) -> Self {
        let of_use = files(root, "rs").into_iter().filter(|path| !path[root.len()..].contains("/tests"));
        Self::new(library, root, of_use.map(|path| (path.clone(), read(&path))))
    }

    /// Modules with the paths of their files.
    pub fn modules(&self) -> impl Iterator<Item = (&Name, &str)> {
        self.files.iter().map(|(module, (path, _))| (module, path.as_str()))
    }

    /// What a name of a file stands for, if the file brings it in.
    pub fn brought_in(&self, module: &[String], name: &str) -> Option<&Name> {
        let (_, named) = self.files.get(module)?;
        named.uses.iter().find(|(_, alias, _)| alias == name).map(|(path, ..)| path)
    }

    /// The module that owns what a path names in the file of a module; none: it is of another crate.
    pub fn owner(&self, from: &[String], path: &[String]) -> Option<Name> {
        self.follow(from, path, PASSED_ON_MAX)
    }

    fn follow(&self, from: &[String], path: &[String], depth: usize) -> Option<Name> {
        let mut base: Name = from.to_vec();
        let mut rest = path;
        match path.first()?.as_str() {
            name if name == "crate" || name == self.library => (base, rest) = (Name::new(), &path[1..]),
            "self" => rest = &path[1..],
            "super" => {
                while rest.first().is_some_and(|name| name == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            name => {
                let known = self.brought_in(from, name);
                base.push(name.to_owned());
                if !self.files.contains_key(&base) {
                    let path = known.filter(|path| path.first().is_some_and(|first| first != name))?;
                    let whole: Name = path.iter().chain(&rest[1..]).cloned().collect();
                    return self.follow(from, &whole, depth.checked_sub(1)?);
                }
                rest = &rest[1..];
            }
        }
        while let Some(name) = rest.first() {
            let child: Name = base.iter().chain([name]).cloned().collect();
            if !self.files.contains_key(&child) {
                break;
            }
            (base, rest) = (child, &rest[1..]);
        }
        let (_, named) = self.files.get(&base)?;
        let passed_on = rest.first().and_then(|name| named.uses.iter().find(|u| u.2 && u.1 == *name));
        match passed_on {
            Some((path, ..)) if depth > 0 => {
                let whole: Name = path.iter().chain(&rest[1..]).cloned().collect();
                self.follow(&base, &whole, depth - 1).or(Some(base))
            }
            _ => Some(base),
        }
    }

    /// Arrows between the files that `has` chooses by their modules.
    pub fn arrows(&self, has: impl Fn(&[String]) -> bool) -> Arrows {
        let mut arrows = Arrows::new();
        for (module, (path, named)) in self.files.iter().filter(|(module, _)| has(module)) {
            let paths = named.uses.iter().map(|(path, ..)| path).chain(&named.paths);
            let owners = paths.filter_map(|path| self.owner(module, path));
            let others = owners.filter(|owner| owner != module && has(owner));
            arrows.insert(path.clone(), others.map(|owner| self.files[&owner].0.clone()).collect());
        }
        arrows
    }
}

/// Crates of the workspace: name of the library in paths, and folder of its sources.
pub fn crates() -> Vec<(String, String)> {
    let workspace: toml::Table = read("Cargo.toml").parse().expect("a manifest");
    let members = workspace["workspace"]["members"].as_array().expect("members");
    let named = members.iter().filter_map(|member| member.as_str()).map(|folder| {
        let manifest: toml::Table = read(format!("{folder}/Cargo.toml")).parse().expect("a manifest");
        (manifest["package"]["name"].as_str().expect("a name").replace('-', "_"), format!("{folder}/src"))
    });
    named.collect()
}
