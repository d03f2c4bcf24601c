//! Arbitrary bytes of a link's stream or datagram, cut anywhere: no panic, no endless loop, bounded lengths.
#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message as _;
use windhover::io::link::wire::{Deframer, MESSAGE_LIMIT};
use windhover::io::proto::link::{Backfill, Live, Thumbnail, ToPayload, ToStation};

fn stream<M: prost::Message + Default>(data: &[u8], read: usize) {
    let mut deframer = Deframer::default();
    for part in data.chunks(read) {
        deframer.push(part);
        loop {
            match deframer.message::<M>() {
                Ok(Some(message)) => assert!(message.encoded_len() <= 2 * MESSAGE_LIMIT),
                Ok(None) => break,
                Err(_) => return,
            }
        }
    }
}

// The first byte selects the length of reads.
fuzz_target!(|data: &[u8]| {
    let Some((&choice, bytes)) = data.split_first() else {
        return;
    };
    let read = usize::from(choice) + 1;
    stream::<ToPayload>(bytes, read);
    stream::<ToStation>(bytes, read);
    stream::<Backfill>(bytes, read);
    let _ = (Live::decode(bytes), Thumbnail::decode(bytes));
});
