/* Bytes, CRC and stamps of both protocols, for the C parts of the package; without Python. */
#ifndef IGTL_GATEWAY_BYTES_H
#define IGTL_GATEWAY_BYTES_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <sys/types.h>

#include "_crc64.h"

/* Bytes are swapped always, and lengths of messages, 32 unsigned bits, are kept in a ssize_t. */
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__ || __SIZEOF_SIZE_T__ < 8
#error "this part is for little-endian machines of 64 bits; Python does its work on others"
#endif

/* Sizes and offsets of igtl_gateway/wire/header.py and message.py; tests/wire/test_header.py compares them. */
#define HEADER_SIZE 58
#define EXTENDED_SIZE 12
#define TICKS_AT 34
#define BODY_SIZE_AT 42
#define CRC_AT 50

#define MATRIX_BYTES 48
#define QUATERNION_BYTES 28
#define POSE_BYTES 56
#define NAMES_AT 12
#define STAMP_DIGITS 19
#define NS_PER_S 1000000000LL
#define FIRST_OF_19_DIGITS 1000000000000000000LL

/* -- bytes ------------------------------------------------------------------------------------------------------- */

static inline uint64_t crc64(const uint8_t *data, ssize_t size) { return crc64_update(0, data, size); }

static uint64_t get_u64(const uint8_t *at)
{
    uint64_t value;
    memcpy(&value, at, 8);
    return __builtin_bswap64(value);
}

static void put_u64(uint8_t *at, uint64_t value)
{
    value = __builtin_bswap64(value);
    memcpy(at, &value, 8);
}

static uint32_t get_u32(const uint8_t *at)
{
    uint32_t word;
    memcpy(&word, at, 4);
    return __builtin_bswap32(word);
}

static void put_u32(uint8_t *at, uint32_t word)
{
    word = __builtin_bswap32(word);
    memcpy(at, &word, 4);
}

static float float_of(uint32_t word)
{
    float value;
    memcpy(&value, &word, 4);
    return value;
}

static uint32_t word_of(float value)
{
    uint32_t word;
    memcpy(&word, &value, 4);
    return word;
}

static double get_f32(const uint8_t *at) { return float_of(get_u32(at)); }

static void put_f32(uint8_t *at, double value) { put_u32(at, word_of((float)value)); }

/* -- stamps (stamp.py) -------------------------------------------------------------------------------------------- */

static int64_t steps[32];

static int64_t ticks_to_ns(uint64_t ticks)
{
    int64_t ns = (int64_t)(ticks >> 32) * NS_PER_S;
    for (int bit = 0; bit < 32; bit++)
        if (ticks & (0x80000000u >> bit))
            ns += steps[bit];
    return ns;
}

static uint64_t ns_to_ticks(int64_t ns)
{
    if (ns < 0)
        ns = 0;
    int64_t rest = ns % NS_PER_S;
    uint64_t ticks = (uint64_t)(ns / NS_PER_S) << 32;
    for (int bit = 0; bit < 32; bit++)
        if (rest >= steps[bit]) {
            ticks |= 0x80000000u >> bit;
            rest -= steps[bit];
        }
    return ticks;
}

static void put_ros_stamp(uint8_t *at, int64_t ns)
{
    int64_t seconds = ns / NS_PER_S, rest = ns % NS_PER_S;
    if (rest < 0) {
        rest += NS_PER_S;
        seconds -= 1;
    }
    uint32_t words[2] = {(uint32_t)seconds, (uint32_t)rest};
    memcpy(at, words, 8);
}

/* Write a stamp as STAMP_DIGITS decimal digits. */
static void put_digits(uint8_t *at, int64_t ns)
{
    for (int i = STAMP_DIGITS - 1; i >= 0; i--, ns /= 10)
        at[i] = (uint8_t)('0' + ns % 10);
}

/* Fill the tables; to be called before anything else here. */
static void begin_bytes(void)
{
    begin_crc64();
    int64_t step = NS_PER_S;
    for (int bit = 0; bit < 32; bit++)
        steps[bit] = step = (step + 1) >> 1;
}

#endif
