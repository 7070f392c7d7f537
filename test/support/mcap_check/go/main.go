// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0

// go run . FILE.mcap ...: reads files of a bag with the Go library of Foxglove and prints their
// content as JSON, one entry per file. It verifies the checksums of chunks, attachments, data
// section and summary, and that the message indexes point to every message, in order.
package main

import (
	"encoding/binary"
	"encoding/json"
	"fmt"
	"hash/crc32"
	"io"
	"os"

	"github.com/foxglove/mcap/go/mcap"
)

type attachment struct {
	Name      string `json:"name"`
	MediaType string `json:"mediaType"`
	Size      int    `json:"size"`
	Content   []byte `json:"content"` // base64 in JSON
}

type found struct {
	Profile     string                       `json:"profile"`
	Streamed    map[string]int               `json:"streamed"`
	Indexed     map[string]int               `json:"indexed"`
	Statistics  map[string]uint64            `json:"statistics"`
	Schemas     map[string]string            `json:"schemas"`
	Channels    map[string]map[string]string `json:"channels"`
	First       uint64                       `json:"first"`
	Last        uint64                       `json:"last"`
	Digests     map[string]uint32            `json:"digests"`
	Chunks      int                          `json:"chunks"`
	Compression []string                     `json:"compression"`
	DataCrc     uint32                       `json:"dataSectionCrc"`
	SummaryCrc  uint32                       `json:"summaryCrc"`
	Metadata    map[string]map[string]string `json:"metadata"`
	Attachments []attachment                 `json:"attachments"`
}

func main() {
	all := []found{}
	for _, path := range os.Args[1:] {
		one := found{
			Streamed:    map[string]int{},
			Indexed:     map[string]int{},
			Schemas:     map[string]string{},
			Channels:    map[string]map[string]string{},
			Digests:     map[string]uint32{},
			Metadata:    map[string]map[string]string{},
			Attachments: []attachment{},
		}
		for _, check := range []func(string, *found) error{stream, index, checksums} {
			if err := check(path, &one); err != nil {
				fmt.Fprintf(os.Stderr, "%s: %v\n", path, err)
				os.Exit(1)
			}
		}
		all = append(all, one)
	}
	if err := json.NewEncoder(os.Stdout).Encode(all); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}

// stream reads the file sequentially; the lexer verifies the checksum of each chunk.
func stream(path string, to *found) error {
	file, err := os.Open(path)
	if err != nil {
		return err
	}
	defer file.Close()
	lexer, err := mcap.NewLexer(file, &mcap.LexerOptions{
		ValidateChunkCRCs:     true,
		ComputeAttachmentCRCs: true,
		AttachmentCallback:    func(reader *mcap.AttachmentReader) error { return to.attach(reader) },
	})
	if err != nil {
		return err
	}
	defer lexer.Close()
	topics := map[uint16]string{}
	for {
		token, record, err := lexer.Next(nil)
		if err == io.EOF {
			return nil
		}
		if err != nil {
			return err
		}
		switch token {
		case mcap.TokenChannel:
			channel, err := mcap.ParseChannel(record)
			if err != nil {
				return err
			}
			topics[channel.ID] = channel.Topic
		case mcap.TokenMessage:
			message, err := mcap.ParseMessage(record)
			if err != nil {
				return err
			}
			topic, known := topics[message.ChannelID]
			if !known {
				return fmt.Errorf("a message of channel %d comes before it", message.ChannelID)
			}
			to.Streamed[topic]++
		case mcap.TokenDataEnd:
			end, err := mcap.ParseDataEnd(record)
			if err != nil {
				return err
			}
			to.DataCrc = end.DataSectionCRC
		}
	}
}

func (to *found) attach(reader *mcap.AttachmentReader) error {
	content, err := io.ReadAll(reader.Data())
	if err != nil {
		return err
	}
	computed, err := reader.ComputedCRC()
	if err != nil {
		return err
	}
	parsed, err := reader.ParsedCRC()
	if err != nil {
		return err
	}
	if parsed != computed {
		return fmt.Errorf("attachment %s: checksum %x, not %x", reader.Name, computed, parsed)
	}
	one := attachment{reader.Name, reader.MediaType, len(content), content}
	to.Attachments = append(to.Attachments, one)
	return nil
}

// index reads through the summary, as a viewer with random access does.
func index(path string, to *found) error {
	file, err := os.Open(path)
	if err != nil {
		return err
	}
	defer file.Close()
	reader, err := mcap.NewReader(file)
	if err != nil {
		return err
	}
	defer reader.Close()
	info, err := reader.Info()
	if err != nil {
		return err
	}
	if info.Statistics == nil {
		return fmt.Errorf("there are no statistics")
	}
	to.Profile = info.Header.Profile
	to.Statistics = info.ChannelCounts()
	to.First, to.Last = info.Statistics.MessageStartTime, info.Statistics.MessageEndTime
	to.Chunks = len(info.ChunkIndexes)
	if len(info.AttachmentIndexes) != len(to.Attachments) {
		return fmt.Errorf("%d of %d attachments are indexed", len(info.AttachmentIndexes), len(to.Attachments))
	}
	for _, entry := range info.AttachmentIndexes {
		if _, err := reader.GetAttachmentReader(entry.Offset); err != nil {
			return err
		}
	}
	seen := map[string]bool{}
	for _, chunk := range info.ChunkIndexes {
		if name := string(chunk.Compression); !seen[name] {
			seen[name] = true
			to.Compression = append(to.Compression, name)
		}
	}
	for _, schema := range info.Schemas {
		to.Schemas[schema.Name] = schema.Encoding
	}
	for _, channel := range info.Channels {
		to.Channels[channel.Topic] = channel.Metadata
	}
	for _, entry := range info.MetadataIndexes {
		record, err := reader.GetMetadata(entry.Offset)
		if err != nil {
			return err
		}
		to.Metadata[record.Name] = record.Metadata
	}
	messages, err := reader.Messages(mcap.UsingIndex(true), mcap.InOrder(mcap.LogTimeOrder))
	if err != nil {
		return err
	}
	previous := uint64(0)
	message := &mcap.Message{}
	for {
		_, channel, _, err := messages.NextInto(message)
		if err == io.EOF {
			return nil
		}
		if err != nil {
			return err
		}
		if message.LogTime < previous {
			return fmt.Errorf("the index is out of order at %d ns", message.LogTime)
		}
		previous = message.LogTime
		to.Indexed[channel.Topic]++
		digest := to.Digests[channel.Topic]
		to.Digests[channel.Topic] = crc32.Update(digest, crc32.IEEETable, message.Data)
	}
}

// checksums verifies the data section and the summary, which the library does not.
func checksums(path string, to *found) error {
	content, err := os.ReadFile(path)
	if err != nil {
		return err
	}
	footer := len(content) - len(mcap.Magic) - 20
	start := binary.LittleEndian.Uint64(content[footer:])
	to.SummaryCrc = binary.LittleEndian.Uint32(content[footer+16:])
	if computed := crc32.ChecksumIEEE(content[start : footer+16]); to.SummaryCrc != computed {
		return fmt.Errorf("summary: checksum %x, not %x", computed, to.SummaryCrc)
	}
	if to.DataCrc != 0 { // 0: no checksum, as in a finalized file
		dataEnd := int(start) - 9 - 4
		if computed := crc32.ChecksumIEEE(content[:dataEnd]); to.DataCrc != computed {
			return fmt.Errorf("data section: checksum %x, not %x", computed, to.DataCrc)
		}
	}
	return nil
}
