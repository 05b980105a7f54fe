/* Bulk messages of compiled streams from ROS to OpenIGTLink; _bulk_to_ros.h says how large ones are converted. */
#ifndef IGTL_GATEWAY_KERNEL_BULK_TO_IGTL_H
#define IGTL_GATEWAY_KERNEL_BULK_TO_IGTL_H

#include "_numbers.h"
#include "_pictures.h"
#include "_points.h"
#include "_surfaces.h"
#include "_tools.h"

/* Find the text of a String; 0: the message needs the full path. */
static int find_text(const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size < 8)
        return 0;
    ssize_t length = get_u32_ros(cdr + 4);
    if (length > size - 8)
        return 0;
    while (length && !cdr[8 + length - 1])
        length--;
    found->data = cdr + 8;
    found->count = length;
    found->size = 4 + length;
    return length <= MAX_TEXT && !plain_text(cdr + 8, length);
}

/* Set the places of a cloud, a picture, of tools or of numbers: ``numbers`` are as express.py has them; 0: they are outside of the
 * sample. */
static int set_places(struct ros_bulk *stream, const ssize_t numbers[], ssize_t count)
{
    stream->height_at = numbers[0], stream->data_at = numbers[1], stream->step = numbers[2];
    stream->x = numbers[3], stream->y = numbers[4], stream->z = numbers[5];
    stream->places = numbers + 6, stream->places_count = count - 6;
    int inside = stream->height_at >= 12 && stream->data_at <= stream->size && stream->data_at >= stream->height_at + 16 &&
                 stream->x >= 0 && stream->y >= 0 && stream->z >= 0 && stream->x + 4 <= stream->step &&
                 stream->y + 4 <= stream->step && stream->z + 4 <= stream->step;
    if (stream->form == TOOLS)
        inside = has_rows_from_ros(stream);
    if (stream->form == NUMBERS)
        inside = has_rows_of_numbers(stream);
    if (stream->form == TRIANGLES)
        inside &= stream->x >= 4 && stream->x <= stream->data_at && stream->height_at <= stream->data_at - 80;
    for (ssize_t i = 6; i < count; i += 2)
        inside &= numbers[i] >= 0 && numbers[i + 1] >= numbers[i] && numbers[i + 1] <= stream->size;
    return inside;
}

/* Find the content of a message; 0: it needs the full path. */
static int find_in_ros(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    ssize_t least = stream->form == TOOLS || stream->form == NUMBERS ? stream->data_at : stream->size;
    found->header_ns = 0;
    if (size < least || least < 4 || !equal(cdr, stream->sample, 0, 4))
        return 0;
    if (stream->form == TEXT)
        return find_text(cdr, size, found);
    if (stream->form == MESH)
        return find_mesh(cdr, size, found);
    for (ssize_t i = 0; i + 1 < stream->places_count; i += 2)
        if (!equal(cdr, stream->sample, stream->places[i], stream->places[i + 1]))
            return 0;
    found->data = cdr + stream->data_at;
    if (stream->form == TRIANGLES) {
        if (!find_marker(stream, cdr, size, found))
            return 0;
    } else if (stream->form == TOOLS) {
        if (!find_tools(stream, cdr, size, found))
            return 0;
    } else if (stream->form == NUMBERS) {
        if (!find_numbers(stream, cdr, size, found))
            return 0;
    } else if (stream->form >= PICTURE) {
        found->count = found->size = stream->step;
        if (size - stream->data_at < found->size)
            return 0;
    } else if (!find_cloud(stream, cdr, size, found)) {
        return 0;
    }
    int32_t seconds;
    memcpy(&seconds, cdr + 4, 4);
    found->header_ns = seconds * NS_PER_S + get_u32_ros(cdr + 8);
    return found->size <= UINT32_MAX;
}

/* Write the next bytes of the content, of which ``done`` are written; return their number, or -1: the message needs the
 * full path. */
static ssize_t put_next(const struct ros_bulk *stream, const struct found *found, uint8_t *out, ssize_t done)
{
    ssize_t block = found->size - done > BLOCK_BYTES ? BLOCK_BYTES : found->size - done;
    if (stream->form == TEXT) {
        if (done == 0) {
            put_u32(out, (uint32_t)MIB_ASCII << 16 | (uint32_t)found->count);
            return 4;
        }
        memcpy(out + done, found->data + done - 4, (size_t)block);
        return block;
    }
    if (stream->form == PICTURE) {
        memcpy(out + done, found->data + done, (size_t)block);
        return block;
    }
    if (stream->form == BLUE_FIRST) {
        put_blue_first(found->data + done, out + done, block);
        return block;
    }
    if (stream->form == MESH || stream->form == TRIANGLES)
        return put_next_of_surface(stream, found, out, done, block);
    if (stream->form == TOOLS)
        return put_tools_to_igtl(stream, found, out);
    if (stream->form == NUMBERS)
        return put_joints(stream, found, out);
    const struct points points = {.first = found->data,
                                  .step = stream->step,
                                  .x = stream->x,
                                  .y = stream->y,
                                  .z = stream->z,
                                  .times = (float)stream->times,
                                  .by = (float)stream->by};
    if (stream->form == POINTS)
        return points_to_igtl(&points, done / POINT_BYTES, block / POINT_BYTES, out + done) ? -1 : block;
    ssize_t places_end = POLYDATA_HEAD + 12 * found->count, numbers = places_end + 4;
    if (done == 0) {
        memset(out, 0, POLYDATA_HEAD);
        put_u32(out, (uint32_t)found->count);
        put_u32(out + 4, 1);
        put_u32(out + 8, (uint32_t)(4 * (found->count + 1)));
        return POLYDATA_HEAD;
    }
    if (done < places_end) {
        ssize_t count = (block < places_end - done ? block : places_end - done) / 12;
        return places_to_igtl(&points, (done - POLYDATA_HEAD) / 12, count, out + done, 12) ? -1 : 12 * count;
    }
    if (done < numbers) {
        put_u32(out + done, (uint32_t)found->count);
        return 4;
    }
    put_numbers(out + done, block / 4, (uint32_t)(done - numbers) / 4);
    return block;
}

/* Write head and tail of a message with this content; the CRC is still to be put.  Returns the CRC of the head. */
static uint64_t put_ends(const struct igtl_form *form, const struct found *found, uint8_t *head, uint8_t *tail,
                         int64_t stamp_ns)
{
    memcpy(head, form->head, (size_t)form->head_size);
    memcpy(tail, form->tail, (size_t)form->tail_size);
    put_u64(head + TICKS_AT, ns_to_ticks(stamp_ns));
    put_u64(head + BODY_SIZE_AT, (uint64_t)(form->head_size + found->size + form->tail_size - HEADER_SIZE));
    put_stamp_digits(tail, form->digits_at, found->header_ns, stamp_ns);
    return crc64_update(0, head + HEADER_SIZE, form->head_size - HEADER_SIZE);
}

/* Write all forms, whose ``out`` have room for head, content and tail; 0: the message needs the full path. */
static int bulk_from_ros(const struct ros_bulk *stream, const struct found *found, const struct igtl_form *forms,
                         ssize_t count, int64_t stamp_ns)
{
    for (ssize_t i = 0; i < count; i++) {
        const struct igtl_form *form = &forms[i];
        uint8_t *content = form->out + form->head_size, *end = content + found->size;
        uint64_t crc = put_ends(form, found, form->out, end, stamp_ns);
        const uint8_t *made = i ? forms[0].out + forms[0].head_size : NULL;
        for (ssize_t done = 0, next; done < found->size; done += next) {
            if (made) {
                next = found->size - done > BLOCK_BYTES ? BLOCK_BYTES : found->size - done;
                memcpy(content + done, made + done, (size_t)next);
            } else if ((next = put_next(stream, found, content, done)) < 0) {
                return 0;
            }
            crc = stream->form == POINTS ? crc64_update_rows(crc, content + done, next / POINT_BYTES)
                                         : crc64_update(crc, content + done, next);
        }
        put_u64(form->out + CRC_AT, crc64_update(crc, end, form->tail_size));
    }
    return 1;
}

/* Write head and tail of all forms around pixels that stay where they are; ``out`` has room for head and tail. */
static inline void frame_pixels(const struct found *found, const struct igtl_form *forms, ssize_t count, int64_t stamp_ns)
{
    for (ssize_t i = 0; i < count; i++) {
        const struct igtl_form *form = &forms[i];
        uint8_t *tail = form->out + form->head_size;
        uint64_t crc = put_ends(form, found, form->out, tail, stamp_ns);
        crc = crc64_update(crc, found->data, found->size);
        put_u64(form->out + CRC_AT, crc64_update(crc, tail, form->tail_size));
    }
}

#endif
