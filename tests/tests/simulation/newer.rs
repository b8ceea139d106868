//! The next version of the programs as this one meets it: what a server, a stop service or an agent that is one version later may say and write.
//!
//! It is this version with a hand between a robot and its servers, and one between a server and its disk: a field in each message and in each row, a
//! section, another version of the wire, and words that nobody here knows where the protocol lets one be said (record 0062). No program has a switch
//! for it. What a robot writes into its files is added to in robot_agent/tests/agent/successor.rs. Invariant: what this version would have said is said
//! too, word for word. Called by the room and by its own tests.

use crate::frame::Frame;
use hyper::body::{Body as HttpBody, Bytes, Frame as HttpFrame, Incoming};
use hyper::header::CONTENT_LENGTH;
use hyper::server::conn::http2;
use hyper::service::service_fn;
use hyper::{Request, Response};
use hyper_util::rt::{TokioExecutor, TokioIo};
use midshift_core::item::{Item, Write};
use midshift_proto::json::pool;
use prost::{Message, encoding};
use prost_reflect::{DynamicMessage, MapKey, MessageDescriptor, ReflectMessage, Value};
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use tokio::io::DuplexStream;
use tonic::Status;
use tonic::body::Body;
use tonic::transport::{Channel, Endpoint, Uri};
use tower::ServiceExt;

/// Numbers of what each message has more, and of a section.
const FIELD: u32 = 30_000;
const SECTION: u32 = 30_001;
/// Messages that have a section more: the parts of a session that are made of sections.
const SECTIONED: [&str; 4] = ["link.v1.Hello", "link.v1.Welcome", "link.v1.Uplink", "link.v1.Downlink"];
/// What each row has more.
const COLUMN: &str = "next_version";
/// A reason that only the next version has.
const REASON: &str = "GRAVITY_LOST_2";
/// Bytes of a length-prefixed message before the message.
const HEAD: usize = 5;
/// Bytes between a robot and the hand on its words.
const BETWEEN_BYTES: usize = 64 * 1024;

/// Numbers of [`midshift_proto::link::v1::UpdateState`] under which a robot may say why, and this version does not: on its way, and on trial.
const ON_THE_WAY: [i32; 4] = [2, 3, 5, 6];
/// On probation, and a state that only the next version has.
const PROBATION: i32 = 5;
const DREAMING: i32 = 99;

/// Which version a program is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Version {
    /// This one.
    #[default]
    This,
    /// The one after it.
    Next,
}

/// Who says or writes something.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Speaker {
    /// An agent.
    Robot,
    /// The server or the stop service.
    Server,
}

/// Which programs of a room are of the next version; clones are the same switch. At first none is.
#[derive(Clone, Default)]
pub struct Newer(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    server: Version,
    robots: BTreeSet<usize>,
    bundle: Option<String>,
    is_hasty: bool,
    said: BTreeMap<(Speaker, String), u64>,
    /// Once frames are kept: the first of each kind that this version says, by what it is made of.
    frames: Option<BTreeMap<BTreeSet<String>, Frame>>,
}

impl Newer {
    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// The server and the stop service are of that version from now on.
    pub fn server_is(&self, version: Version) {
        self.state().server = version;
    }
    /// These robots are of the next version from their next start on.
    pub fn robots_are_next(&self, robots: impl IntoIterator<Item = usize>) {
        self.state().robots = robots.into_iter().collect();
    }
    /// Who runs this bundle is of the next version.
    pub fn comes_with(&self, bundle: String) {
        self.state().bundle = Some(bundle);
    }
    /// The next version is a bad one: its agents say a state that nobody may say while somebody older listens.
    pub fn hastens(&self) {
        self.state().is_hasty = true;
    }
    /// What a process of a robot that starts from this bundle says, and hears.
    pub fn voice(&self, robot: usize, bundle: Option<String>) -> Voice {
        let state = self.state();
        let is_next = state.robots.contains(&robot) || (bundle.is_some() && bundle == state.bundle);
        Voice { newer: self.clone(), robot: if is_next { Version::Next } else { Version::This } }
    }
    /// How often something more was said in messages of this name, or how often such a word was.
    pub fn said(&self, speaker: Speaker, what: &str) -> u64 {
        self.state().said.get(&(speaker, what.to_owned())).copied().unwrap_or(0)
    }
    /// The same of all messages and words.
    pub fn said_by(&self, speaker: Speaker) -> u64 {
        self.state().said.iter().filter(|((by, _), _)| *by == speaker).map(|(_, times)| times).sum()
    }
    /// From now on the first frame of each kind that this version says is kept.
    pub fn keep_frames(&self) {
        self.state().frames = Some(BTreeMap::new());
    }
    /// Those that were kept.
    pub fn frames(&self) -> Vec<Frame> {
        self.state().frames.iter().flat_map(|frames| frames.values().cloned()).collect()
    }
    /// What a server's disk is given.
    pub fn writes(&self, mut items: Vec<Item>) -> Vec<Item> {
        let mut state = self.state();
        if state.server == Version::Next {
            for change in items.iter_mut().flat_map(|item| &mut item.rows) {
                if let Write::Put { body, .. } = &mut change.write
                    && let Ok(Json::Object(mut row)) = serde_json::from_str::<Json>(body)
                {
                    row.insert(COLUMN.to_owned(), Json::from(7));
                    *body = Json::Object(row).to_string().into();
                    state.count(Speaker::Server, "row");
                }
            }
        }
        items
    }
}

impl State {
    fn count(&mut self, speaker: Speaker, what: &str) {
        *self.said.entry((speaker, what.to_owned())).or_insert(0) += 1;
    }

    /// Puts in what is new, in this message and in all of its parts that are ours.
    fn add(&mut self, speaker: Speaker, message: &mut DynamicMessage) {
        let kind = message.descriptor();
        let Some(name) = kind.full_name().strip_prefix("midshift.") else { return };
        self.say_words(speaker, name, message);
        for (_, value) in message.fields_mut() {
            match value {
                Value::Message(part) => self.add(speaker, part),
                Value::List(parts) => self.add_to_each(speaker, parts.iter_mut()),
                Value::Map(parts) => self.add_to_each(speaker, parts.values_mut()),
                _ => {}
            }
        }
        let mut field = Vec::new();
        encoding::uint32::encode(FIELD, &7, &mut field);
        if SECTIONED.contains(&name) {
            let section = field.clone();
            encoding::bytes::encode(SECTION, &section, &mut field);
        }
        message.merge(field.as_slice()).expect("fields that nobody knows");
        self.count(speaker, name);
    }

    fn add_to_each<'a>(&mut self, speaker: Speaker, parts: impl Iterator<Item = &'a mut Value>) {
        parts.filter_map(Value::as_message_mut).for_each(|part| self.add(speaker, part));
    }

    /// Words of the next version, where the protocol lets a receiver meet one that it does not know.
    fn say_words(&mut self, speaker: Speaker, name: &str, message: &mut DynamicMessage) {
        match (speaker, name) {
            (Speaker::Robot, "link.v1.Hello") => {
                if let Some(Value::List(versions)) = message.get_field_by_name_mut("protocol_versions") {
                    versions.push(Value::U32(2));
                    self.count(speaker, "version of the wire");
                }
            }
            (Speaker::Robot, "link.v1.Inventory") => {
                if let Some(Value::List(capabilities)) = message.get_field_by_name_mut("capabilities") {
                    capabilities.push(Value::String("levitate".to_owned()));
                    self.count(speaker, "capability");
                }
                if let Some(Value::Map(labels)) = message.get_field_by_name_mut("labels") {
                    labels.insert(MapKey::String("next-version".to_owned()), Value::String("7".to_owned()));
                    self.count(speaker, "label");
                }
            }
            (Speaker::Robot, "link.v1.UpdateReport") => self.say_why(speaker, message),
            (Speaker::Server, "link.v1.Close") => {
                if let Some(Value::Message(why)) = message.get_field_by_name_mut("reason") {
                    why.set_field_by_name("code", Value::String(REASON.to_owned()));
                    self.count(speaker, "reason");
                }
            }
            _ => {}
        }
    }

    /// Says why an update is where it is; or, in haste, that it is where no older version knows to be.
    fn say_why(&mut self, speaker: Speaker, report: &mut DynamicMessage) {
        let state = report.get_field_by_name("state").and_then(|state| state.as_enum_number()).unwrap_or_default();
        if self.is_hasty && state == PROBATION {
            report.set_field_by_name("state", Value::EnumNumber(DREAMING));
            self.count(speaker, "state before its time");
        }
        if ON_THE_WAY.contains(&state) && !report.has_field_by_name("reason") {
            let kind = pool().get_message_by_name("midshift.common.v1.Reason").expect("is in common.proto");
            let mut why = DynamicMessage::new(kind);
            why.set_field_by_name("code", Value::String(REASON.to_owned()));
            why.set_field_by_name("message", Value::String("it floats".to_owned()));
            report.set_field_by_name("reason", Value::Message(why));
            self.count(speaker, "reason");
        }
    }
}

/// What one process of a robot says, and what it hears of servers.
#[derive(Clone)]
pub struct Voice {
    newer: Newer,
    robot: Version,
}

impl Voice {
    /// A connection like `server`, on which both ends may be of the next version.
    ///
    /// # Errors
    /// None but those of a connection within this machine.
    pub async fn over(&self, endpoint: &Endpoint, server: Channel) -> Result<Channel, tonic::transport::Error> {
        let voice = self.clone();
        let connect = move |_: Uri| {
            let (near, far) = tokio::io::duplex(BETWEEN_BYTES);
            tokio::spawn(voice.clone().carry(far, server.clone()));
            async move { Ok::<_, io::Error>(TokioIo::new(near)) }
        };
        endpoint.connect_with_connector(tower::service_fn(connect)).await
    }

    /// Passes on what comes from the robot until it closes its end.
    async fn carry(self, far: DuplexStream, server: Channel) {
        let pass = service_fn(move |request: Request<Incoming>| {
            let passed = self.clone().pass(server.clone(), request);
            async move { Ok::<_, Infallible>(passed.await) }
        });
        // An end that breaks is the end of a process or of its session.
        let _ = http2::Builder::new(TokioExecutor::new()).serve_connection(TokioIo::new(far), pass).await;
    }

    async fn pass(self, server: Channel, mut request: Request<Incoming>) -> Response<Body> {
        let Some((asked, answered)) = kinds(request.uri().path()) else {
            return Status::unimplemented("nothing is called so").into_http();
        };
        request.headers_mut().remove(CONTENT_LENGTH);
        let voice = self.clone();
        let request = request.map(|body| voice.told(Speaker::Robot, asked, Body::new(body)));
        match server.oneshot(request).await {
            Ok(mut response) => {
                response.headers_mut().remove(CONTENT_LENGTH);
                response.map(|body| self.told(Speaker::Server, answered, body))
            }
            Err(error) => Status::unavailable(error.to_string()).into_http(),
        }
    }

    fn told(&self, speaker: Speaker, kind: MessageDescriptor, inner: Body) -> Body {
        Body::new(Told { voice: self.clone(), speaker, kind, inner, held: Vec::new() })
    }

    fn says(&self, speaker: Speaker, kind: &MessageDescriptor, said: &[u8]) -> Vec<u8> {
        let mut state = self.newer.state();
        let version = match speaker {
            Speaker::Robot => self.robot,
            Speaker::Server => state.server,
        };
        if version == Version::This {
            if let Some(frames) = &mut state.frames {
                let frame = Frame { message: kind.full_name().to_owned(), bytes: said.to_vec() };
                frames.entry(frame.parts()).or_insert(frame);
            }
            return said.to_vec();
        }
        let mut message = DynamicMessage::decode(kind.clone(), said).expect("what a program says can be read");
        state.add(speaker, &mut message);
        message.encode_to_vec()
    }
}

/// What a method is asked with, and what it answers.
fn kinds(path: &str) -> Option<(MessageDescriptor, MessageDescriptor)> {
    let (service, method) = path.strip_prefix('/')?.split_once('/')?;
    let service = pool().get_service_by_name(service)?;
    let method = service.methods().find(|known| known.name() == method)?;
    Some((method.input(), method.output()))
}

/// One direction of one call.
struct Told {
    voice: Voice,
    speaker: Speaker,
    kind: MessageDescriptor,
    inner: Body,
    /// The beginning of a message.
    held: Vec<u8>,
}

impl Told {
    /// The messages that are whole by now, as they are said.
    fn whole(&mut self) -> Bytes {
        let mut whole = Vec::new();
        while let Some([is_compressed, length @ ..]) = self.held.first_chunk::<HEAD>().copied() {
            assert_eq!(is_compressed, 0, "robots and servers do not compress");
            let end = HEAD + u32::from_be_bytes(length) as usize;
            if self.held.len() < end {
                break;
            }
            let message: Vec<u8> = self.held.drain(..end).skip(HEAD).collect();
            let said = self.voice.says(self.speaker, &self.kind, &message);
            whole.push(is_compressed);
            whole.extend_from_slice(&(said.len() as u32).to_be_bytes());
            whole.extend_from_slice(&said);
        }
        whole.into()
    }
}

impl HttpBody for Told {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<HttpFrame<Self::Data>, Self::Error>>> {
        loop {
            let frame = match ready!(Pin::new(&mut self.inner).poll_frame(cx)) {
                Some(Ok(frame)) => frame,
                end => return Poll::Ready(end),
            };
            let data = match frame.into_data() {
                Ok(data) => data,
                Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
            };
            self.held.extend_from_slice(&data);
            let whole = self.whole();
            if !whole.is_empty() {
                return Poll::Ready(Some(Ok(HttpFrame::data(whole))));
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }
}
