/* Bounds that several rooms of the passage share. */
#ifndef IGTL_GATEWAY_PASSAGE_LIMITS_H
#define IGTL_GATEWAY_PASSAGE_LIMITS_H

#include "../kernel/_bytes.h"

#define NAMES_BYTES 34 /* of a header: version, type, device name */
#define BUCKETS 64
#define MAX_OUTPUTS 8
#define MAX_LINKS 64
#define CHUNK_BYTES (64 * 1024)
#define MOST_UNSENT (1024 * 1024) /* that Python has not queued yet */
#define LARGEST_OUTPUT (256 * 1024)
#define LARGEST_INPUT (32 * 1024)   /* what is larger takes too long for a thread of the middleware */
#define LARGEST_RECEIVED (256 * 1024) /* what is larger takes too long for the thread that reads the links */
#define LARGEST_RECORDED (512 * 1024) /* an input and its outputs, which are copied under the locks */
#define LARGEST_MADE (64 * 1024 * 1024) /* outputs of a message that is converted without the sequence lock */
#define MAX_PARTS 3 /* of a message that is sent: what is before a picture, the picture, what is after it */
#define MAX_PLACES 70             /* of a sample, see express.py */
#define TIMED_PHASES 5
#define TIME_BUCKETS 256
#define MAX_LARGE_STREAMS 64

#endif
