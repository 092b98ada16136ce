// Lines: what is received and sent, with its checksum.

#include "box.h"

#include <avr/interrupt.h>
#include <string.h>
#include <util/crc16.h>

char line[LINE + 1];
static uint8_t length;
static char *rest;  // of the line: arguments that were not read
static uint16_t crc;

static volatile char ring[RING];
static volatile uint8_t head, tail;

ISR(USART_RX_vect) {
  char c = UDR0;
  uint8_t next = (head + 1) % RING;
  age = 0;
  if (c == '!') {
    stop = 1;
  } else if (next != tail) {
    ring[head] = c;
    head = next;
  }
}

void start_line(void) {
  UCSR0A = _BV(U2X0);
  UBRR0 = 3;  // 500 kbaud, exactly
  UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
  UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

uint8_t line_waits(void) { return head != tail; }

void drop_received(void) { tail = head; }

void drop_line(void) { length = 0; }

uint8_t receive(void) {
  char c = ring[tail];
  tail = (tail + 1) % RING;
  if (c == '\n') return length > 0;
  if (c != '\r' && length <= LINE) line[length++] = c;
  return 0;
}

uint16_t checksum(const void *data, uint8_t n) {
  uint16_t sum = 0xFFFF;
  for (const uint8_t *byte = data; n--; byte++) sum = _crc_xmodem_update(sum, *byte);
  return sum;
}

uint8_t undamaged(void) {
  uint32_t sum;
  if (length < 6 || length > LINE || line[length - 5] != '*') return 0;
  line[length] = 0;
  line[length - 5] = ' ';
  rest = line + length - 5;
  if (!number(&sum, 0xFFFF)) return 0;
  length -= 5;
  line[length] = 0;
  return checksum(line, length) == sum && line[1] == ' ';
}

uint8_t is_command(const char *name) {
  uint8_t n = strlen(name);
  rest = line + 2 + n;
  return !strncmp(line + 2, name, n) && (!*rest || *rest == ' ');
}

uint8_t number(uint32_t *value, uint32_t most) {
  uint8_t n = 0;
  *value = 0;
  if (*rest++ != ' ') return 0;
  for (;; rest++, n++) {
    char c = *rest | 0x20;
    uint8_t digit = c >= '0' && c <= '9' && *rest >= '0' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : 16;
    if (digit > 15) break;
    if (n == 8) return 0;
    *value = *value << 4 | digit;
  }
  return n && *value <= most && (*rest == ' ' || !*rest);
}

uint8_t at_end(void) { return !*rest; }

uint8_t mask_given(uint32_t *value) { return number(value, OUTPUTS) && !(*value & ~(uint32_t)OUTPUTS); }

static void send(char c) {
  while (!(UCSR0A & _BV(UDRE0))) continue;
  UDR0 = c;
  crc = _crc_xmodem_update(crc, c);
}

static void say(const char *text) {
  while (*text) send(*text++);
}

static void say_hex(uint32_t number, uint8_t n_digits) {
  while (n_digits--) {
    uint8_t digit = (number >> (4 * n_digits)) & 15;
    send(digit < 10 ? '0' + digit : 'a' + digit - 10);
  }
}

void say_number(uint32_t number, uint8_t n_digits) {
  send(' ');
  say_hex(number, n_digits);
}

void begin(const char *text) {
  crc = 0xFFFF;
  say(text);
}

void end(void) {
  uint16_t sum = crc;
  send('*');
  say_hex(sum, 4);
  send('\n');
}

void reply(const char *text) {
  char tag[] = {line[0], ' ', 0};
  begin(tag);
  say(text);
}

void refuse(const char *reason) {
  reply("no ");
  say(reason);
  end();
}

void accept(void) {
  reply("ok");
  end();
}
