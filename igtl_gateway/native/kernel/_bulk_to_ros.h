/* Bulk messages of compiled streams from OpenIGTLink to ROS.
 *
 * A large content is converted in blocks that fit the processor's cache, and the CRC of a block is taken while it is
 * there: each byte is read from and written to memory once.  The other direction does the same.
 */
#ifndef IGTL_GATEWAY_KERNEL_BULK_TO_ROS_H
#define IGTL_GATEWAY_KERNEL_BULK_TO_ROS_H

#include "_metadata.h"
#include "_points.h"
#include "_surfaces.h"
#include "_tools.h"

/* Return whether all but content, stamp, CRC and message id of ``data`` is as in the sample. */
static int bulk_from_igtl_fits(const struct igtl_bulk *stream, const uint8_t *data, ssize_t size)
{
    const uint8_t *sample = stream->sample;
    ssize_t at = stream->at, tail = stream->tail;
    if (size < at + tail || !equal(data, sample, 0, TICKS_AT) ||
        get_u64(data + BODY_SIZE_AT) != (uint64_t)(size - HEADER_SIZE))
        return 0;
    ssize_t extended = sample[1] == 2 ? EXTENDED_SIZE : 0; /* its last 4 bytes are the message id */
    if (extended && !equal(data, sample, HEADER_SIZE, HEADER_SIZE + EXTENDED_SIZE - 4))
        return 0;
    if (stream->landmarks && !has_labels(stream, data + at, size - at - tail))
        return 0;
    return equal(data, sample, HEADER_SIZE + extended, at) && !memcmp(data + size - tail, sample + at, (size_t)tail);
}

static int ascii_compatible(uint32_t encoding)
{
    return encoding == MIB_ASCII || encoding == 4 || encoding == 106 || encoding == 2252;
}

/* Whether a form that the caller has read has room for what is filled in. */
static int has_room(const struct ros_form *form)
{
    ssize_t before = form->room - form->rest;
    if (form->stamp_at < 0 || form->width_at < 0 || form->rest < 0)
        return 0;
    if (form->form == TOOLS)
        return has_tool_rows(form);
    if (form->form == LANDMARKS)
        return has_landmark_rows(form);
    return form->form == TEXT || form->form == MESH ||
           (before >= 32 && form->stamp_at + 8 <= before && form->width_at + 4 <= before);
}

/* Set count and size of a form for this content; 0: the message needs the full path. */
static int prepare_form(struct ros_form *form, const uint8_t *content, ssize_t size)
{
    if (form->form == METADATA) {
        form->size = form->room;
        return 1;
    }
    if (form->form == LANDMARKS) {
        form->count = form->rest / LANDMARK_TO_ROS;
        form->size = form->room - form->rest;
        return size == POINT_BYTES * form->count;
    }
    if (form->form == TEXT) {
        uint32_t head = size < 4 ? 0 : get_u32(content);
        form->size = 4 + size + 1;
        return size >= 4 && size == 4 + (ssize_t)(head & 0xFFFF) && ascii_compatible(head >> 16);
    }
    if (form->form == PICTURE || form->form == VOLUME) {
        form->size = form->room + size;
        return size == (ssize_t)get_u32_ros(form->template + form->room - form->rest - 4);
    }
    if (form->form == TOOLS) {
        form->count = form->rest / TOOL_TO_ROS;
        form->size = form->room - form->rest;
        return has_tools(form, content, size);
    }
    if (form->form == MESH || form->form == TRIANGLES) {
        if (!count_surface(content, size, form))
            return 0;
        form->size = form->form == MESH ? vertices_at(form->cells) + 24 * form->count : form->room + 72 * form->cells;
        return 1;
    }
    if (form->form == CLOUD) {
        if (!count_cloud(content, size, &form->count))
            return 0;
    } else if (size && size % POINT_BYTES == 0) {
        form->count = size / POINT_BYTES;
    } else {
        return 0;
    }
    if (form->form == POINT) {
        form->size = form->count == 1 ? form->room : 0;
        return 1;
    }
    ssize_t bytes = form->count * (form->form == CLOUD ? ROW_OF_CLOUD : ROW_OF_POINTS);
    form->size = form->room + bytes + 1;
    return bytes <= UINT32_MAX;
}

/* Write the stamp of a message, or of each of its poses. */
static void put_stamps(const struct ros_form *form, int64_t stamp_ns)
{
    if (form->stamp_at)
        put_ros_stamp(form->out + form->stamp_at, stamp_ns);
    for (ssize_t i = 0; form->form == TOOLS && i < form->count; i++) {
        uint32_t stamp_at = get_u32_ros(tool_row(form, i) + 24);
        if (stamp_at)
            put_ros_stamp(form->out + stamp_at, stamp_ns);
    }
}

/* Write everything of a message but its content. */
static void put_frame(const struct ros_form *form, ssize_t size, int64_t stamp_ns)
{
    uint8_t *out = form->out;
    if (form->form == TEXT) {
        memcpy(out, "\0\1\0\0", 4);
        put_u32_ros(out + 4, (uint32_t)(size - 4 + 1));
        out[form->size - 1] = 0;
        return;
    }
    if (form->form == MESH) {
        ssize_t vertices = vertices_at(form->cells);
        memcpy(out, "\0\1\0\0", 4);
        put_u32_ros(out + 4, (uint32_t)form->cells);
        put_u32_ros(out + vertices - 4, 0); /* padding, or the next */
        put_u32_ros(out + 8 + 12 * form->cells, (uint32_t)form->count);
        return;
    }
    ssize_t before = form->room - form->rest;
    memcpy(out, form->template, (size_t)before);
    if (form->form == TRIANGLES || form->form == VOLUME)
        memcpy(out + form->size - form->rest, form->template + before, (size_t)form->rest);
    if (form->form == TRIANGLES)
        put_u32_ros(out + form->width_at, (uint32_t)(3 * form->cells));
    if (form->form == CLOUD || form->form == POINTS) {
        uint32_t bytes = (uint32_t)(form->size - form->room - 1);
        put_u32_ros(out + form->width_at, (uint32_t)form->count);
        put_u32_ros(out + form->room - 8, bytes);
        put_u32_ros(out + form->room - 4, bytes);
        out[form->size - 1] = 1; /* is_dense */
    }
    put_stamps(form, stamp_ns);
}

/* Convert the block of the content from ``begin`` to ``end``; not 0: the message needs the full path. */
static uint32_t put_block(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content,
                          ssize_t begin, ssize_t end)
{
    float times = (float)stream->times, by = (float)stream->by;
    uint32_t labels = stream->landmarks ? 0 : UINT32_MAX;
    uint8_t *out = form->out + form->room;
    if (form->form == VOLUME)
        out -= form->rest;
    if (form->form == PICTURE || form->form == VOLUME) {
        memcpy(out + begin, content + begin, (size_t)(end - begin));
        return 0;
    }
    if (form->form == TEXT) {
        if (begin == 0)
            begin = 4;
        memcpy(form->out + 4 + begin, content + begin, (size_t)(end - begin));
        return plain_text(content + begin, end - begin);
    }
    if (form->form == METADATA)
        return 0;
    if (form->form == TOOLS)
        return begin ? 0 : put_tools(form, stream, content);
    if (form->form == LANDMARKS)
        return begin ? 0 : put_landmarks(form, stream, content);
    if (form->form == POINT)
        return put_point(form->out + form->size - 24, content, stream->times, stream->by, labels);
    if (form->form == POINTS)
        return put_points(out + begin / POINT_BYTES * ROW_OF_POINTS, content + begin, (end - begin) / POINT_BYTES, times,
                          by, labels);
    uint32_t odd = 0;
    if (form->form == MESH || form->form == TRIANGLES)
        return put_surface_block(form, stream, content, begin, end);
    if (begin == 0)
        begin = POLYDATA_HEAD;
    ssize_t places_end = POLYDATA_HEAD + 12 * form->count, numbers = places_end + 4;
    if (begin < places_end) {
        ssize_t until = end < places_end ? end : places_end;
        odd = floats_to_ros(content + begin, out + begin - POLYDATA_HEAD, (until - begin) / 4, times, by);
    }
    if (end > numbers) {
        ssize_t from = begin > numbers ? begin : numbers;
        odd |= are_numbers(content + from, (end - from) / 4, (uint32_t)(from - numbers) / 4);
    }
    return odd;
}

/* Convert a message that fits to all forms, whose ``out`` have room for ``size`` bytes; 0: it needs the full path. */
static int bulk_from_igtl(const struct igtl_bulk *stream, const uint8_t *data, ssize_t size, const struct ros_form *forms,
                          ssize_t count, int64_t stamp_ns)
{
    const uint8_t *content = data + stream->at;
    ssize_t content_size = size - stream->at - stream->tail;
    for (ssize_t i = 0; i < count; i++) {
        if (forms[i].size)
            put_frame(&forms[i], content_size, stamp_ns);
        if (forms[i].form == METADATA)
            put_message_id(forms[i].out, forms[i].width_at, data);
    }
    uint64_t crc = stream->check_crc ? crc64_update(0, data + HEADER_SIZE, stream->at - HEADER_SIZE) : 0;
    for (ssize_t begin = 0; begin < content_size; begin += BLOCK_BYTES) {
        ssize_t end = content_size - begin > BLOCK_BYTES ? begin + BLOCK_BYTES : content_size;
        const uint8_t *block = content + begin;
        for (ssize_t i = 0; i < count; i++) {
            if (forms[i].size && put_block(&forms[i], stream, content, begin, end))
                return 0;
            if (forms[i].form == PICTURE)
                block = forms[i].out + forms[i].room + begin; /* a large copy is cached, its source is not */
        }
        if (stream->check_crc)
            crc = crc64_update(crc, block, end - begin);
    }
    return !stream->check_crc || crc64_update(crc, data + size - stream->tail, stream->tail) == get_u64(data + CRC_AT);
}

#endif
