//! Watches: answers that go on, at the pace of whoever reads them.
//!
//! Invariant: a message is composed only once the reader asks for one, so between the two there is one at most; a watch that has news and is
//! not read ends after [`limits::WATCH_UNREAD`], and gives back what it holds.

use crate::status;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use std::fmt::{self, Debug, Formatter};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use tokio::sync::Notify;
use tokio::time::timeout;
use tokio_stream::Stream;
use tonic::Status;

/// What lies between the two.
struct Between<T> {
    message: Option<Result<T, Status>>,
    is_asked: bool,
    /// The reader has just taken a message.
    is_taken: bool,
    has_teller: bool,
    has_reader: bool,
    reader: Option<Waker>,
}

struct Shared<T> {
    between: Mutex<Between<T>>,
    /// The reader asks, or has gone. Heard by all who wait: one for the question, another for the end.
    moved: Notify,
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, Between<T>> {
        self.between.lock().unwrap_or_else(PoisonError::into_inner)
    }
    fn put_message(&self, message: Result<T, Status>) {
        let mut between = self.lock();
        if between.has_reader {
            between.message = Some(message);
        }
        between.is_asked = false;
        if let Some(reader) = between.reader.take() {
            reader.wake();
        }
    }
    async fn until<R>(&self, mut found: impl FnMut(&Between<T>) -> Option<R>) -> R {
        loop {
            let moved = self.moved.notified();
            if let Some(found) = found(&self.lock()) {
                return found;
            }
            moved.await;
        }
    }
}

/// Whoever watched has gone, or did not read for too long: there is nobody to tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gone;

/// Tells one watcher. Dropped: the watch has ended.
pub struct Teller<T>(Arc<Shared<T>>);

/// What one watcher reads.
pub struct Reader<T>(Arc<Shared<T>>);

/// A watch: who tells, and what is read of it.
pub fn watch<T>() -> (Teller<T>, Reader<T>) {
    let between =
        Between { message: None, is_asked: false, is_taken: false, has_teller: true, has_reader: true, reader: None };
    let shared = Arc::new(Shared { between: Mutex::new(between), moved: Notify::new() });
    (Teller(shared.clone()), Reader(shared))
}

impl<T> Teller<T> {
    /// Waits until the watcher asks for a message. Called when there is news; nothing is composed before.
    ///
    /// # Errors
    /// It has gone, or has not asked for [`limits::WATCH_UNREAD`]: then the watch ends with WATCH_UNREAD, whenever it is read.
    pub async fn asked(&self) -> Result<(), Gone> {
        let asked = self.0.until(|between| match between {
            Between { has_reader: false, .. } => Some(Err(Gone)),
            Between { is_asked: true, .. } => Some(Ok(())),
            _ => None,
        });
        timeout(Duration::from_millis(limits::WATCH_UNREAD.as_ms()), asked).await.unwrap_or_else(|_| {
            self.end(status(&Refusal::new(Kind::Exhausted, Code::WatchUnread), None));
            Err(Gone)
        })
    }
    /// Tells what was asked for.
    pub fn tell_message(&self, message: T) {
        self.0.put_message(Ok(message));
    }
    /// The last word, in the place of whatever was not read.
    pub fn end(&self, why: Status) {
        self.0.put_message(Err(why));
    }
    /// Waits until the watcher has gone.
    pub async fn gone(&self) {
        self.0.until(|between| (!between.has_reader).then_some(())).await;
    }
    /// Whether the watcher has gone.
    pub fn is_gone(&self) -> bool {
        !self.0.lock().has_reader
    }
}

impl<T> Drop for Teller<T> {
    fn drop(&mut self) {
        let mut between = self.0.lock();
        between.has_teller = false;
        if let Some(reader) = between.reader.take() {
            reader.wake();
        }
    }
}

impl<T> Stream for Reader<T> {
    type Item = Result<T, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let mut between = self.0.lock();
        if let Some(message) = between.message.take() {
            between.is_taken = true;
            return Poll::Ready(Some(message));
        }
        if !between.has_teller {
            return Poll::Ready(None);
        }
        // An encoder looks for a second message to send with the first. It asks when it comes again, which is when there is room to send.
        if std::mem::take(&mut between.is_taken) {
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        between.reader = Some(context.waker().clone());
        between.is_asked = true;
        drop(between);
        self.0.moved.notify_waiters();
        Poll::Pending
    }
}

impl<T> Debug for Reader<T> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reader").finish_non_exhaustive()
    }
}

impl<T> Drop for Reader<T> {
    fn drop(&mut self) {
        let mut between = self.0.lock();
        (between.has_reader, between.message) = (false, None);
        drop(between);
        self.0.moved.notify_waiters();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::refusal_of;
    use std::sync::Weak;
    use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
    use std::task::Wake;
    use tokio_stream::StreamExt;

    #[tokio::test(start_paused = true)]
    async fn nothing_is_asked_for_before_it_is_read_and_everything_told_is_read_in_order() {
        let (teller, mut reader) = watch();
        let telling = tokio::spawn(async move {
            for n in 0..3 {
                teller.asked().await.expect("a reader");
                teller.tell_message(n);
            }
        });
        let mut read = Vec::new();
        while let Some(message) = reader.next().await {
            read.push(message.expect("no refusal"));
        }
        assert_eq!(read, [0, 1, 2]);
        telling.await.expect("no panic");
    }

    #[tokio::test(start_paused = true)]
    async fn a_watch_with_news_that_nobody_reads_gives_back_what_it_holds_and_says_why_when_it_is_read() {
        let (teller, mut reader) = watch::<Arc<str>>();
        let message: Arc<str> = "news".into();
        let held: Weak<str> = Arc::downgrade(&message);
        teller.tell_message(message);
        assert_eq!(teller.asked().await, Err(Gone));
        assert!(held.upgrade().is_none(), "the message is given back");
        drop(teller);
        let why = reader.next().await.expect("a last word").expect_err("a refusal");
        assert_eq!(refusal_of(&why).code, Some(Code::WatchUnread));
        assert!(reader.next().await.is_none());
    }

    /// How often it was woken.
    #[derive(Default)]
    struct Woken(AtomicU32);

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Relaxed);
        }
    }

    #[test]
    fn who_has_just_taken_a_message_asks_for_the_next_one_when_it_comes_again() {
        let (teller, mut reader) = watch();
        let woken = Arc::new(Woken::default());
        let waker = Waker::from(woken.clone());
        let mut context = Context::from_waker(&waker);
        let is_asked = || teller.0.lock().is_asked;
        teller.tell_message(1);
        assert!(Pin::new(&mut reader).poll_next(&mut context).is_ready());
        assert!(Pin::new(&mut reader).poll_next(&mut context).is_pending());
        assert_eq!((is_asked(), woken.0.load(Relaxed)), (false, 1), "the message may lie in a buffer: it comes again");
        assert!(Pin::new(&mut reader).poll_next(&mut context).is_pending());
        assert_eq!((is_asked(), woken.0.load(Relaxed)), (true, 1));
    }

    #[tokio::test(start_paused = true)]
    async fn a_question_is_heard_also_while_somebody_else_waits_for_the_end() {
        let (teller, mut reader) = watch();
        let telling = tokio::spawn(async move {
            let two = async {
                for n in 0..2 {
                    teller.asked().await.expect("a reader");
                    teller.tell_message(n);
                }
            };
            tokio::select! {
                biased;
                () = teller.gone() => panic!("nobody has gone"),
                () = two => {}
            }
        });
        tokio::task::yield_now().await;
        assert_eq!(reader.next().await.expect("a message").expect("no refusal"), 0);
        assert_eq!(reader.next().await.expect("a message").expect("no refusal"), 1);
        telling.await.expect("no panic");
    }

    #[tokio::test(start_paused = true)]
    async fn a_watcher_that_goes_is_noticed_whether_it_is_waited_for_or_told() {
        let (teller, reader) = watch::<u8>();
        drop(reader);
        teller.gone().await;
        assert!(teller.is_gone());
        assert_eq!(teller.asked().await, Err(Gone));
    }
}
