//! What a row may be made of: its structs with their fields and its enums with their words, as a type asks for them while it is read.
//!
//! Invariant: a shape is what the reader knows, not what one row has: of an enum all words are noted, whichever stands in the row.
//! Each struct is given one more field than its row has, so a type that refuses fields it does not know cannot be read here.

use serde::de::value::StringDeserializer;
use serde::de::{
    DeserializeOwned, DeserializeSeed, Deserializer, EnumAccess, Error as _, IntoDeserializer, MapAccess, SeqAccess,
    VariantAccess, Visitor,
};
use serde::forward_to_deserialize_any;
use serde_json::{Error, Map, Value};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

/// A field that no release has.
const FOREIGN: &str = "of_a_later_release";

/// Places of a row and what may stand there: `task_state.phase` an enum, `task_state` a struct.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Shapes(pub BTreeMap<String, BTreeSet<String>>);

impl Shapes {
    /// Reads `value` as `T` and notes what it asks for, as standing at `name`.
    ///
    /// # Errors
    /// If it is no `T`, or a part of `T` refuses a field that it does not know.
    pub fn read<T: DeserializeOwned>(&mut self, name: &str, value: &Value) -> Result<T, Error> {
        let noted = RefCell::new(std::mem::take(&mut self.0));
        let read = T::deserialize(Reader { value, at: name.to_owned(), noted: &noted });
        self.0 = noted.into_inner();
        read
    }
    /// One line for each place.
    pub fn text(&self) -> String {
        let line = |(at, words): (&String, &BTreeSet<String>)| {
            let words: Vec<&str> = words.iter().map(String::as_str).collect();
            format!("{at} {}\n", words.join(" "))
        };
        self.0.iter().map(line).collect()
    }
    /// From [`Shapes::text`].
    pub fn parse(text: &str) -> Self {
        let line = |line: &str| {
            let mut words = line.split(' ').map(str::to_owned);
            Some((words.next()?, words.filter(|word| !word.is_empty()).collect()))
        };
        Self(text.lines().filter_map(line).collect())
    }
}

type Noted = RefCell<BTreeMap<String, BTreeSet<String>>>;

struct Reader<'de, 'n> {
    value: &'de Value,
    at: String,
    noted: &'n Noted,
}

impl<'de, 'n> Reader<'de, 'n> {
    fn below(&self, value: &'de Value, step: &str) -> Self {
        Self { value, at: format!("{}{step}", self.at), noted: self.noted }
    }
    fn note(&self, kind: &str, words: &[&str]) {
        let mut noted = self.noted.borrow_mut();
        let at = noted.entry(format!("{}:{kind}", self.at)).or_default();
        at.extend(words.iter().map(|word| (*word).to_owned()));
    }
    fn fields(&self, fields: &'de Map<String, Value>, names: Option<&'static [&'static str]>) -> Fields<'de, 'n, '_> {
        Fields { of: self, rest: fields.iter(), next: None, names, is_foreign_due: names.is_some() }
    }
}

impl<'de, 'n> Deserializer<'de> for Reader<'de, 'n> {
    type Error = Error;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        match self.value {
            Value::Null => visitor.visit_unit(),
            Value::Bool(b) => visitor.visit_bool(*b),
            Value::Number(n) => match (n.as_u64(), n.as_i64()) {
                (Some(n), _) => visitor.visit_u64(n),
                (_, Some(n)) => visitor.visit_i64(n),
                _ => visitor.visit_f64(n.as_f64().unwrap_or_default()),
            },
            Value::String(s) => visitor.visit_str(s),
            Value::Array(items) => visitor.visit_seq(Items { of: &self, rest: items.iter() }),
            Value::Object(fields) => visitor.visit_map(self.fields(fields, None)),
        }
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        if self.value.is_null() { visitor.visit_none() } else { visitor.visit_some(self) }
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _: &'static str, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        self.note("fields", names);
        match self.value {
            Value::Object(fields) => visitor.visit_map(self.fields(fields, Some(names))),
            _ => self.deserialize_any(visitor),
        }
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &'static str,
        words: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        self.note("words", words);
        match self.value {
            Value::String(_) => visitor.visit_enum(Word { of: &self, word: self.value, content: None }),
            Value::Object(one) if one.len() == 1 => match one.iter().next() {
                Some((word, content)) => {
                    let word = Value::String(word.clone());
                    visitor.visit_enum(Word { of: &self, word: &word, content: Some(content) })
                }
                None => Err(Error::custom("an empty enum")),
            },
            other => Err(Error::custom(format!("{other} at {} is no enum", self.at))),
        }
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit unit_struct seq tuple
        tuple_struct map identifier ignored_any
    }
}

struct Items<'de, 'n, 'o> {
    of: &'o Reader<'de, 'n>,
    rest: std::slice::Iter<'de, Value>,
}

impl<'de> SeqAccess<'de> for Items<'de, '_, '_> {
    type Error = Error;
    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Error> {
        self.rest.next().map(|value| seed.deserialize(self.of.below(value, "[]"))).transpose()
    }
}

/// Fields of a struct, or entries of a map where there are no names.
struct Fields<'de, 'n, 'o> {
    of: &'o Reader<'de, 'n>,
    rest: serde_json::map::Iter<'de>,
    next: Option<(String, &'de Value)>,
    names: Option<&'static [&'static str]>,
    is_foreign_due: bool,
}

impl<'de> MapAccess<'de> for Fields<'de, '_, '_> {
    type Error = Error;
    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Error> {
        let (key, value) = match self.rest.next() {
            Some((key, value)) => (key.clone(), value),
            None if std::mem::take(&mut self.is_foreign_due) => (FOREIGN.to_owned(), &Value::Null),
            None => return Ok(None),
        };
        let step = if self.names.is_some() { format!(".{key}") } else { ".*".to_owned() };
        self.next = Some((step, value));
        seed.deserialize(Key(key)).map(Some)
    }
    fn next_value_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<T::Value, Error> {
        let (step, value) = self.next.take().ok_or_else(|| Error::custom("a value without a key"))?;
        seed.deserialize(self.of.below(value, &step))
    }
}

/// Key of an object: a text, or a number as text.
struct Key(String);

impl<'de> Deserializer<'de> for Key {
    type Error = Error;
    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_string(self.0)
    }
    fn deserialize_u64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_u64(self.0.parse().map_err(Error::custom)?)
    }
    fn deserialize_u32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        self.deserialize_u64(visitor)
    }
    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _: &'static str, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_newtype_struct(self)
    }
    fn deserialize_enum<V: Visitor<'de>>(
        self,
        name: &'static str,
        words: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        let text: StringDeserializer<Error> = self.0.into_deserializer();
        text.deserialize_enum(name, words, visitor)
    }
    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u128 f32 f64 char str string bytes byte_buf option unit unit_struct seq tuple
        tuple_struct map struct identifier ignored_any
    }
}

/// A word of an enum, with what it holds.
struct Word<'de, 'n, 'o, 'w> {
    of: &'o Reader<'de, 'n>,
    word: &'w Value,
    content: Option<&'de Value>,
}

impl<'de, 'n, 'o> EnumAccess<'de> for Word<'de, 'n, 'o, '_> {
    type Error = Error;
    type Variant = Content<'de, 'n>;
    fn variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<(T::Value, Content<'de, 'n>), Error> {
        let word = self.word.as_str().unwrap_or_default().to_owned();
        let content = self.content.map(|value| self.of.below(value, &format!(".{word}")));
        Ok((seed.deserialize(Key(word))?, Content(content)))
    }
}

struct Content<'de, 'n>(Option<Reader<'de, 'n>>);

impl<'de, 'n> Content<'de, 'n> {
    fn there(self) -> Result<Reader<'de, 'n>, Error> {
        self.0.ok_or_else(|| Error::custom("a word that holds something, without it"))
    }
}

impl<'de> VariantAccess<'de> for Content<'de, '_> {
    type Error = Error;
    fn unit_variant(self) -> Result<(), Error> {
        match self.0 {
            None => Ok(()),
            Some(content) if content.value.is_null() => Ok(()),
            Some(content) => Err(Error::custom(format!("{} holds nothing", content.at))),
        }
    }
    fn newtype_variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<T::Value, Error> {
        seed.deserialize(self.there()?)
    }
    fn tuple_variant<V: Visitor<'de>>(self, _: usize, visitor: V) -> Result<V::Value, Error> {
        self.there()?.deserialize_any(visitor)
    }
    fn struct_variant<V: Visitor<'de>>(self, names: &'static [&'static str], visitor: V) -> Result<V::Value, Error> {
        self.there()?.deserialize_struct("", names, visitor)
    }
}

#[cfg(test)]
mod tests {
    use super::Shapes;
    use serde::Deserialize;
    use serde_json::json;
    use std::collections::BTreeMap;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Way {
        Idle,
        Drives { to: String },
        Holds(Vec<Load>),
    }

    #[derive(Debug, PartialEq, Deserialize)]
    struct Load {
        grams: Option<u32>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    struct Row {
        way: Way,
        loads: BTreeMap<u64, Load>,
    }

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Strict {
        #[serde(rename = "n")]
        _n: u32,
    }

    #[test]
    fn a_row_is_read_and_every_field_and_word_that_its_type_knows_is_noted() {
        let mut shapes = Shapes::default();
        let row: Row = shapes.read("row", &json!({"way": "idle", "loads": {"7": {"grams": null}}})).expect("a row");
        let loads = [(7, Load { grams: None })].into();
        assert_eq!(row, Row { way: Way::Idle, loads });
        for held in [json!({"drives": {"to": "A01"}}), json!({"holds": [{"grams": 3}]})] {
            let row: Row = shapes.read("row", &json!({"way": held, "loads": {}})).expect("a row");
            assert!(
                matches!(&row.way, Way::Drives { to } if to == "A01")
                    || row.way == Way::Holds(vec![Load { grams: Some(3) }])
            );
        }
        let text = "row.loads.*:fields grams\nrow.way.drives:fields to\nrow.way.holds[]:fields grams\n\
                    row.way:words drives holds idle\nrow:fields loads way\n";
        assert_eq!(shapes.text(), text);
        assert_eq!(Shapes::parse(text), shapes);
    }

    #[test]
    fn a_type_that_refuses_a_field_of_a_later_release_cannot_be_read() {
        let refused = Shapes::default().read::<Strict>("row", &json!({"n": 1})).expect_err("refused");
        assert!(refused.to_string().contains("of_a_later_release"), "{refused}");
    }

    #[test]
    fn a_word_that_nobody_knows_is_refused() {
        assert!(Shapes::default().read::<Way>("way", &json!("flies")).is_err());
    }
}
